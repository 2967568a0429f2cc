"""Stiff and extreme cases, and how often a false value has no flag."""
