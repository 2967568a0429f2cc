"""Processes of this machine, object stores behind URLs, and atomic writing of local files."""
