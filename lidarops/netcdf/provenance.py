"""Provenance of a product: W3C PROV-JSON, identifier, versions of packages and date."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Mapping
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import version
from itertools import groupby
from operator import attrgetter
from typing import Any, Final
from uuid import NAMESPACE_URL, uuid5

from lidarops.errors import ProductError
from lidarops.records import InputRecord, LeftOut, Provenance

EPOCH_VARIABLE: Final = "SOURCE_DATE_EPOCH"
NAMESPACE: Final = "urn:lidarops:"

_quoted: Final = json.JSONEncoder().encode

_PACKAGES: Final = ("lidarops", "netCDF4", "numba", "numpy", "scipy", "xarray")


def prov_json(provenance: Provenance) -> str:
    """Return the provenance of a product as W3C PROV-JSON (`provo2013`).

    Inputs with equal content are one entity, because a product depends on content only.

    Returns
    -------
    str
        ASCII, with sorted keys; independent of the order of the inputs.
    """
    inputs = sorted(provenance.inputs, key=attrgetter("sha256", "path", "role"))
    entities = {
        "lidarops:product": _canonical(_product(provenance)),
        "lidarops:plan": _canonical(_plan(provenance)),
        **{
            f"sha256:{digest}": _input(list(records))
            for digest, records in groupby(inputs, key=attrgetter("sha256"))
        },
    }
    uses = {
        f"_:use{number}": '{"prov:activity":"lidarops:processing",'
        f'"prov:entity":"sha256:{record.sha256}","prov:role":"{record.role}"}}'
        for number, record in enumerate(inputs, start=1)
    }
    others = {
        "prefix": {"lidarops": NAMESPACE, "sha256": "urn:sha256:"},
        "activity": {"lidarops:processing": {"lidarops:scene": provenance.scene}},
        "agent": {"lidarops:software": _software(provenance)},
        "wasGeneratedBy": {
            "_:generation": {
                "prov:entity": "lidarops:product",
                "prov:activity": "lidarops:processing",
            }
        },
        "wasAssociatedWith": {
            "_:association": {
                "prov:activity": "lidarops:processing",
                "prov:agent": "lidarops:software",
                "prov:plan": "lidarops:plan",
            }
        },
    }
    members = {key: _canonical(value) for key, value in others.items()}
    return _object({**members, "entity": _object(entities), "used": _object(uses)})


def _canonical(value: Any) -> str:
    return json.dumps(value, sort_keys=True, separators=(",", ":"))


def _object(members: Mapping[str, str]) -> str:
    """Return a canonical JSON object of members that are JSON texts already.

    For thousands of inputs, `json` would take longer than writing the product.
    """
    return f"{{{','.join([f'{_quoted(key)}:{members[key]}' for key in sorted(members)])}}}"


def _type(name: str) -> dict[str, str]:
    return {"$": name, "type": "prov:QUALIFIED_NAME"}


def _product(provenance: Provenance) -> dict[str, Any]:
    return {
        "prov:type": _type("lidarops:Product"),
        "lidarops:id": product_id(provenance),
        "lidarops:campaign": provenance.campaign,
        "lidarops:scene": provenance.scene,
        "lidarops:kind": provenance.kind,
        "lidarops:channel": provenance.channel,
        "lidarops:settings": _canonical(dict(provenance.settings)),
    }


def _plan(provenance: Provenance) -> dict[str, Any]:
    plan = provenance.plan
    return {
        "prov:type": _type("prov:Plan"),
        "lidarops:sha256": plan.hash,
        # The text of this digest.
        "lidarops:json": _canonical(plan.as_dict()),
        "lidarops:left_out": [
            f"{omission.name} of {omission.channel}: {omission.reason}{_rule(omission)}"
            for omission in plan.left_out
        ],
    }


def _rule(omission: LeftOut) -> str:
    """Return the rule that decided and its number, in brackets."""
    number = "" if omission.number is None else f", {omission.number:g}"
    return f" [{omission.rule}{number}]" if omission.rule else ""


def _input(records: list[InputRecord]) -> str:
    paths = [_quoted(record.path) for record in records]
    path = paths[0] if len(paths) == 1 else f"[{','.join(paths)}]"
    return (
        f'{{"lidarops:path":{path},"lidarops:sha256":"{records[0].sha256}",'
        '"prov:type":{"$":"lidarops:RawFile","type":"prov:QUALIFIED_NAME"}}'
    )


def _software(provenance: Provenance) -> dict[str, Any]:
    return {
        "prov:type": _type("prov:SoftwareAgent"),
        "lidarops:code_version": provenance.code_version,
        "lidarops:versions": [
            f"{name} {number}" for name, number in sorted(provenance.versions.items())
        ],
    }


def product_id(provenance: Provenance) -> str:
    """Return the identifier of a product: equal for equal inputs, plan, settings and code.

    Returns
    -------
    str
        UUID version 5 of kind, channel, inputs' sha256, plan hash, settings and code version.
    """
    content = {
        "kind": provenance.kind,
        "channel": provenance.channel,
        "plan": provenance.plan.hash,
        "settings": dict(provenance.settings),
        "code_version": provenance.code_version,
    }
    inputs = sorted([f'["{record.role}","{record.sha256}"]' for record in provenance.inputs])
    members = {key: _canonical(value) for key, value in content.items()}
    text = _object({**members, "inputs": f"[{','.join(inputs)}]"})
    return str(uuid5(NAMESPACE_URL, NAMESPACE + text))


@cache
def package_versions() -> Mapping[str, str]:
    """Return the versions of Python and of the packages that can change a product."""
    return {name: version(name) for name in _PACKAGES} | {"python": platform.python_version()}


def writing_time() -> datetime:
    """Return the time now in UTC to the second, or that of ``SOURCE_DATE_EPOCH`` if it is set.

    Raises
    ------
    ProductError
        If ``SOURCE_DATE_EPOCH`` is not a number of seconds.
    """
    return _epoch() or datetime.now(UTC).replace(microsecond=0)


def _epoch() -> datetime | None:
    """Return the time of ``SOURCE_DATE_EPOCH``; None where it is not set."""
    epoch = os.environ.get(EPOCH_VARIABLE, "")
    if not epoch:
        return None
    try:
        return datetime.fromtimestamp(int(epoch), UTC)
    except (ValueError, OverflowError, OSError) as error:
        raise ProductError(
            f"is {epoch!r}, not a number of seconds",
            field=EPOCH_VARIABLE,
            remedy="set it to whole seconds since 1970-01-01, or unset it",
        ) from error
