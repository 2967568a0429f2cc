"""Many products as one: a virtual dataset, means over time, an index, STAC items.

Everything here is derived from product files and can be thrown away and made again.
Import from the modules; heavy packages are needed by what needs them only.
"""
