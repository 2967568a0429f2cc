"""The ``multiangle`` product: optical depth and extinction from scans."""
