"""The ``signal`` product: range-corrected signals of one channel."""
