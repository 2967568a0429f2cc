"""The campaign file: its settings, their validation, and the ancillary files that it names."""
