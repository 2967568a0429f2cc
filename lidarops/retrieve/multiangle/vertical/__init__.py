"""Optical depths of single heights joined into one profile of smooth extinction."""
