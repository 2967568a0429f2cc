"""What all benchmarks share: terms, timing, results."""
