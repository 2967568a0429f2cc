"""Background, amplitude and extinction of a homogeneous path."""
