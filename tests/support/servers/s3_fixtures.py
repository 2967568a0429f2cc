"""A local S3 server for the tests of object stores."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator

import pytest

from support.servers.ports import KEYS, free_port, wait_for


@pytest.fixture(scope="module")
def s3(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """URL of a bucket on a local S3 server."""
    pytest.importorskip("moto.server")
    s3fs = pytest.importorskip("s3fs")
    port = free_port()
    endpoint = f"http://127.0.0.1:{port}"
    process = subprocess.Popen(
        [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    with pytest.MonkeyPatch.context() as patch:
        for name, value in KEYS.items():
            patch.setenv(name, value)
        patch.setenv("AWS_ENDPOINT_URL", endpoint)
        try:
            wait_for(port, process)
            # One of an earlier test may be connected elsewhere.
            s3fs.S3FileSystem.clear_instance_cache()
            s3fs.S3FileSystem().mkdir("archive")
            yield "s3://archive"
        finally:
            s3fs.S3FileSystem.clear_instance_cache()
            process.kill()
            process.wait()
