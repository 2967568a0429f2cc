"""Processes of this machine (`processes`), object stores behind URLs (`stores`), atomic writing of
files (`files`)."""
