"""The background of a profile: tail mean, cubic of a homogeneous path, known shape."""
