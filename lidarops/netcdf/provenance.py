"""Provenance of a product: W3C PROV-JSON, identifier, versions of packages and date."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import version
from itertools import groupby
from operator import attrgetter
from typing import Any, Final
from uuid import NAMESPACE_URL, uuid5

from lidarops.errors import ProductError
from lidarops.records import Provenance, Role

EPOCH_VARIABLE: Final = "SOURCE_DATE_EPOCH"
NAMESPACE: Final = "urn:lidarops:"

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
    files = {}
    for digest, group in groupby(inputs, key=attrgetter("sha256")):
        records = list(group)
        paths = [record.path for record in records]
        sort = "Product" if records[0].role is Role.PRODUCT else "RawFile"
        files[f"sha256:{digest}"] = {
            "prov:type": prov_type(f"lidarops:{sort}"),
            "lidarops:path": paths[0] if len(paths) == 1 else paths,
            "lidarops:sha256": digest,
        }
    return prov_document(
        "lidarops:product",
        ("lidarops:processing", {"lidarops:scene": provenance.scene}),
        {
            "lidarops:product": {
                "prov:type": prov_type("lidarops:Product"),
                "lidarops:id": product_id(provenance),
                "lidarops:campaign": provenance.campaign,
                "lidarops:scene": provenance.scene,
                "lidarops:kind": provenance.kind,
                "lidarops:channel": provenance.channel,
                "lidarops:settings": canonical(dict(provenance.settings)),
            },
            "lidarops:plan": _plan(provenance),
            **files,
        },
        ({"prov:entity": f"sha256:{record.sha256}", "prov:role": record.role} for record in inputs),
        (provenance.code_version, provenance.versions),
        {"prov:plan": "lidarops:plan"},
    )


def prov_document(
    result: str,
    activity: tuple[str, Mapping[str, str]],
    entities: Mapping[str, Any],
    uses: Iterable[Mapping[str, str]],
    software: tuple[str, Mapping[str, str]],
    association: Mapping[str, str],
) -> str:
    """Return how a file was made as W3C PROV-JSON: ASCII, with sorted keys.

    Parameters
    ----------
    result : str
        Name of the entity that was made.
    activity : (str, mapping of str to str)
        Name of what made it, and what is stated of that.
    entities : mapping of str to dict
    uses : iterable of mapping of str to str
        What was used, besides the activity.
    software : (str, mapping of str to str)
        Code version, and the versions of packages.
    association : mapping of str to str
        What is stated of how the software did it.
    """
    name, stated = activity
    code_version, versions = software
    of_activity = {"prov:activity": name}
    document = {
        "prefix": {"lidarops": NAMESPACE, "sha256": "urn:sha256:"},
        "entity": entities,
        "activity": {name: stated},
        "agent": {
            "lidarops:software": {
                "prov:type": prov_type("prov:SoftwareAgent"),
                "lidarops:code_version": code_version,
                "lidarops:versions": [f"{key} {versions[key]}" for key in sorted(versions)],
            }
        },
        "wasGeneratedBy": {"_:generation": {"prov:entity": result, **of_activity}},
        "wasAssociatedWith": {
            "_:association": {"prov:agent": "lidarops:software", **of_activity, **association}
        },
        "used": {f"_:use{number}": {**of_activity, **use} for number, use in enumerate(uses, 1)},
    }
    return canonical(document)


def canonical(value: Any) -> str:
    """Return JSON with sorted keys, without spaces."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"))


def prov_type(name: str) -> dict[str, str]:
    """Return the type of an entity or agent."""
    return {"$": name, "type": "prov:QUALIFIED_NAME"}


def _plan(provenance: Provenance) -> dict[str, Any]:
    plan, omissions = provenance.plan, []
    for omission in plan.left_out:
        number = "" if omission.number is None else f", {omission.number:g}"
        rule = f" [{omission.rule}{number}]" if omission.rule else ""
        omissions.append(f"{omission.name} of {omission.channel}: {omission.reason}{rule}")
    return {
        "prov:type": prov_type("prov:Plan"),
        "lidarops:sha256": plan.hash,
        # The text of this digest.
        "lidarops:json": canonical(plan.as_dict()),
        "lidarops:left_out": omissions,
    }


def product_id(provenance: Provenance) -> str:
    """Return the identifier of a product: equal for equal inputs, plan, settings and code.

    Returns
    -------
    str
        UUID version 5 of kind, channel, inputs' sha256, plan hash, settings and code version.
    """
    return identifier(
        {
            "kind": provenance.kind,
            "channel": provenance.channel,
            "inputs": sorted([record.role, record.sha256] for record in provenance.inputs),
            "plan": provenance.plan.hash,
            "settings": dict(provenance.settings),
            "code_version": provenance.code_version,
        }
    )


def identifier(content: Mapping[str, Any]) -> str:
    """Return the UUID version 5 of plain JSON types."""
    return str(uuid5(NAMESPACE_URL, NAMESPACE + canonical(content)))


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
    epoch = os.environ.get(EPOCH_VARIABLE, "")
    if not epoch:
        return datetime.now(UTC).replace(microsecond=0)
    try:
        return datetime.fromtimestamp(int(epoch), UTC)
    except (ValueError, OverflowError, OSError) as error:
        raise ProductError(
            f"is {epoch!r}, not a number of seconds",
            field=EPOCH_VARIABLE,
            remedy="set it to whole seconds since 1970-01-01, or unset it",
        ) from error
