"""Many products as one: a lazy dataset, means over time, an index, stores, STAC items.

Everything here is derived from product files, and can be deleted and made again. Optional packages
are imported only by the functions that need them.
"""
