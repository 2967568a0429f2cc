"""Data reduction and drawing of products, for the report and the site."""
