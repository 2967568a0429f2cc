"""Prefect flows over lidarops: thin, no logic of their own."""
