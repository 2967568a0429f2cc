"""The stability benchmark, `study`: false values without a flag in random scenes."""
