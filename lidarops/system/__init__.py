"""File systems, object stores and processes of a machine."""
