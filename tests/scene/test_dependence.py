"""Dependences of products, with fixed digests."""

from __future__ import annotations

import hashlib

from hypothesis import given
from hypothesis import strategies as st

from lidarops.records import InputRecord, Role, digest
from lidarops.scene import dependence

DIGESTS = st.integers(0, 3).map(lambda k: hashlib.sha256(bytes([k])).hexdigest())
RECORDS = st.builds(InputRecord, st.text(), st.sampled_from(Role), DIGESTS)


@given(st.lists(RECORDS, max_size=12))
def test_inputs_have_the_digest_of_their_sorted_contents(files):
    contents = sorted([used.role.value, used.sha256] for used in files)
    assert dependence.inputs_digest(files) == digest(contents)
    assert dependence.inputs_digest(files[::-1]) == digest(contents)
