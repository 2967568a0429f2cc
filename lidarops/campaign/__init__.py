"""What a person writes: the campaign file, its validation, and the files that it names."""
