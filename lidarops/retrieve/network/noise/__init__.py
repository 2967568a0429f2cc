"""Outlying bins of the beams of a network, and groups of profiles with similar noise."""
