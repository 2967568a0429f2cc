"""The ``signal`` product: background-subtracted, range-corrected signals of one channel."""
