"""Scenes, and what runs for each of them: pure data, decided before any signal is read."""
