"""What all retrievals share: checks of their inputs, and the cache of compiled code."""
