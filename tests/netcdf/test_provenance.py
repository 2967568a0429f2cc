"""Provenance of a product, and the versions of packages."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st
from support.products.encoded_products import build_product
from support.products.made_products import context, homogeneous, provenance

from lidarops.errors import ProductError
from lidarops.netcdf.context import package_versions, product_id, prov_json
from lidarops.netcdf.read import read_provenance
from lidarops.netcdf.write import write_plain, write_product
from lidarops.records import InputRecord, LeftOut, Role

RELATIONS = {
    "wasGeneratedBy": {"prov:entity": "entity", "prov:activity": "activity"},
    "used": {"prov:activity": "activity", "prov:entity": "entity"},
    "wasAssociatedWith": {
        "prov:activity": "activity",
        "prov:agent": "agent",
        "prov:plan": "entity",
    },
}


def test_provenance_reads_back_from_a_product(tmp_path: Path):
    path = tmp_path / "product.nc"
    product = build_product(homogeneous(), context())
    write_product(product, path)
    document = read_provenance(path)
    assert document == json.loads(prov_json(provenance()))
    assert document["entity"]["lidarops:product"]["lidarops:id"] == product.attrs["id"]
    plan = document["entity"]["lidarops:plan"]
    assert plan["lidarops:sha256"] == product.attrs["lidarops_plan_sha256"]


def test_document_is_prov_and_holds_everything():
    given_ = provenance()
    document = json.loads(prov_json(given_))
    assert set(document) == {"prefix", "entity", "activity", "agent", *RELATIONS}
    for relation, ends in RELATIONS.items():
        for name, record in document[relation].items():
            assert name.startswith("_:")
            for role, kind in ends.items():
                assert record[role] in document[kind]
    prefixes = {*document["prefix"], "prov"}
    for kind in ("entity", "activity", "agent"):
        for name, record in document[kind].items():
            assert {name.split(":")[0], *(key.split(":")[0] for key in record)} <= prefixes
    files = {
        record["lidarops:path"]: record["lidarops:sha256"]
        for record in document["entity"].values()
        if "lidarops:path" in record
    }
    assert files == {record.path: record.sha256 for record in given_.inputs}
    roles = sorted(record["prov:role"] for record in document["used"].values())
    assert roles == ["dark", "signal", "signal", "signal"]


def test_the_plan_can_be_checked_against_its_hash():
    given_ = provenance()
    plan = json.loads(prov_json(given_))["entity"]["lidarops:plan"]
    digest = hashlib.sha256(plan["lidarops:json"].encode()).hexdigest()
    assert digest == plan["lidarops:sha256"] == given_.plan.hash
    assert plan["lidarops:left_out"] == ["dark of photon_532o: photon counting has no dark\nsignal"]
    steps = json.loads(plan["lidarops:json"])["steps"]
    assert steps[0]["settings"] == {"wavelength": 5.32e-7}


def test_unknown_wavelengths_keep_the_document_strict_json():
    given_ = provenance(settings={"wavelength": float("nan")})

    def refuse(constant: str) -> None:
        raise AssertionError(constant)

    json.loads(prov_json(given_), parse_constant=refuse)
    assert prov_json(given_).isascii()


def test_equal_files_are_one_entity_used_twice():
    inputs = (
        InputRecord("a.dat", Role.SIGNAL, "a" * 64),
        InputRecord("b.dat", Role.DARK, "a" * 64),
    )
    document = json.loads(prov_json(provenance(inputs=inputs)))
    assert document["entity"][f"sha256:{'a' * 64}"]["lidarops:path"] == ["a.dat", "b.dat"]
    assert len(document["used"]) == 2


@settings(deadline=None)
@given(st.permutations(provenance().inputs))
def test_order_of_inputs_changes_nothing(inputs):
    shuffled = provenance(inputs=tuple(inputs))
    assert prov_json(shuffled) == prov_json(provenance())
    assert product_id(shuffled) == product_id(provenance())


CONTENTS = st.sampled_from([hashlib.sha256(bytes([k])).hexdigest() for k in range(3)])


@given(st.lists(st.builds(InputRecord, st.text(min_size=1), st.sampled_from(Role), CONTENTS)))
def test_documents_are_canonical_json_whatever_files_are_called(inputs):
    text = prov_json(provenance(inputs=tuple(inputs)))
    found = json.loads(text)
    assert text == json.dumps(found, sort_keys=True, separators=(",", ":"))
    assert len(found["used"]) == len(inputs)
    for record in inputs:
        paths = found["entity"][f"sha256:{record.sha256}"]["lidarops:path"]
        assert record.path in ([paths] if isinstance(paths, str) else paths)


def test_identifiers_differ_where_content_may():
    base = provenance()
    plan = replace(base.plan, left_out=(*base.plan.left_out, LeftOut("x", "y", "z")))
    others = [
        provenance("signal"),
        provenance(channel="analog_1064o"),
        provenance(inputs=base.inputs[1:]),
        provenance(inputs=(replace(base.inputs[0], sha256="e" * 64), *base.inputs[1:])),
        provenance(plan=plan),
        provenance(settings={}),
        provenance(code_version="f" * 16),
    ]
    identifiers = {product_id(other) for other in (base, *others)}
    assert len(identifiers) == len(others) + 1
    # The path of a file is not part of its content.
    moved = tuple(replace(record, path=f"moved/{record.path}") for record in base.inputs)
    assert product_id(provenance(inputs=moved)) == product_id(base)


def test_files_without_provenance_are_refused(tmp_path: Path):
    with pytest.raises(ProductError, match=r"nowhere\.nc"):
        read_provenance(tmp_path / "nowhere.nc")
    (tmp_path / "text.nc").write_text("no NetCDF")
    with pytest.raises(ProductError, match=r"text\.nc"):
        read_provenance(tmp_path / "text.nc")
    write_plain(xr.Dataset({"x": ("n", np.arange(3.0))}), tmp_path / "other.nc")
    with pytest.raises(ProductError, match="provenance"):
        read_provenance(tmp_path / "other.nc")
    write_plain(xr.Dataset({"provenance": "not json"}), tmp_path / "odd.nc")
    with pytest.raises(ProductError, match="not JSON"):
        read_provenance(tmp_path / "odd.nc")
    write_plain(xr.Dataset({"provenance": "[" * 100_000}), tmp_path / "deep.nc")
    with pytest.raises(ProductError, match="not JSON"):
        read_provenance(tmp_path / "deep.nc")
    write_plain(xr.Dataset({"provenance": ("n", np.arange(3.0))}), tmp_path / "array.nc")
    with pytest.raises(ProductError, match=r"array\.nc"):
        read_provenance(tmp_path / "array.nc")


def test_packages_of_this_installation():
    versions = package_versions()
    assert versions["numpy"] == np.__version__
    assert {"lidarops", "netCDF4", "numba", "python", "scipy", "xarray"} <= set(versions)
