"""Scale a Kubernetes deployment for the time of a run, with the rights of the calling pod."""

from __future__ import annotations

import json
import ssl
from collections.abc import Iterator
from contextlib import contextmanager
from http.client import HTTPConnection, HTTPException, HTTPSConnection
from pathlib import Path
from urllib.parse import urlsplit

IDENTITY = Path("/var/run/secrets/kubernetes.io/serviceaccount")
"""Folder in which Kubernetes gives a pod its ``token`` and the API's ``ca.crt``."""

_TIMEOUT = 30.0


@contextmanager
def scaled(api: str, namespace: str, deployment: str, *, replicas: int) -> Iterator[None]:
    """Run a deployment with some replicas; scale it to none at the end of the context.

    Parameters
    ----------
    api : str
        Address of the API server.
    namespace, deployment : str
    replicas : int

    Raises
    ------
    OSError
        If the API cannot be reached or refuses.
    """
    _scale(api, namespace, deployment, replicas)
    try:
        yield
    finally:
        _scale(api, namespace, deployment, 0)


def _scale(api: str, namespace: str, deployment: str, replicas: int) -> None:
    path = f"/apis/apps/v1/namespaces/{namespace}/deployments/{deployment}/scale"
    connection = _connection(api)
    try:
        connection.request(
            "PATCH",
            path,
            body=json.dumps({"spec": {"replicas": replicas}}),
            headers={
                "Content-Type": "application/merge-patch+json",
                "Authorization": f"Bearer {(IDENTITY / 'token').read_text().strip()}",
            },
        )
        response = connection.getresponse()
        text = response.read().decode(errors="replace")
    except HTTPException as error:
        raise ConnectionError(f"{api}{path}: {error!r}") from error
    finally:
        connection.close()
    if response.status >= 300:
        raise ConnectionError(f"{api}{path}: {response.status} {text[:500]}")


def _connection(api: str) -> HTTPConnection:
    address = urlsplit(api)
    if address.scheme == "http":
        return HTTPConnection(address.netloc, timeout=_TIMEOUT)
    context = ssl.create_default_context(cafile=str(IDENTITY / "ca.crt"))
    return HTTPSConnection(address.netloc, timeout=_TIMEOUT, context=context)
