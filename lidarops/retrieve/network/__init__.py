"""Extinction and visibility where the beams of several lidars meet."""
