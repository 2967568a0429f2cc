"""Signals of the beams of a network: averaged, with their noise and outlying bins."""
