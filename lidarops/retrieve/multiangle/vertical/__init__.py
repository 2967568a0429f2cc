"""Optical depths of single altitudes combined into one profile with smooth extinction."""
