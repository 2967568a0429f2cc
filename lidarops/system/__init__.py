"""Processes of this machine (`processes`) and object stores behind URLs (`stores`)."""
