"""Optical depth and extinction from scans at several zenith angles."""
