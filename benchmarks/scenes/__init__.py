"""Scenes with known truth, chosen and random ones, of benchmarks and of tests."""
