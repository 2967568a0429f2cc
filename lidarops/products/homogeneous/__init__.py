"""The ``homogeneous`` product: extinction of homogeneous range sections."""
