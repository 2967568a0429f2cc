"""Product files: variables and attributes, building, writing (the only writer), reading."""
