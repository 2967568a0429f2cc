"""The ``visibility`` product: extinction and visibility from networks of lidars."""
