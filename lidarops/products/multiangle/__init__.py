"""The ``multiangle`` product: optical depth and extinction from scans over zenith angle."""
