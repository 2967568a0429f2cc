"""Independent references of the retrievals, slow and easy to read, and scenes to test them on."""
