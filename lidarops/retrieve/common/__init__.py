"""Shared by all retrievals: input checks, array layout and the cache of compiled code.

`inputs` turns arguments into contiguous (profile, bin) arrays or raises `RetrievalInputError`.
`arrays.frozen` gives compiled functions arrays of one type. `compiled_code.keep_apart`
gives every state of the sources its own cache of compiled code; importing this package calls it
once.
"""

from lidarops.retrieve.common.compiled_code import keep_apart

# Before any function is compiled. Settings of a retrieval load none of this.
keep_apart()
