"""Molecular atmosphere and visibility."""
