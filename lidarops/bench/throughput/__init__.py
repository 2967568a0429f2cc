"""Speed of readers, retrievals, campaigns and archives."""
