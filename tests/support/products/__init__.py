"""Synthetic results, products and run records, and the compliance check of a product."""
