"""Clusters: choice by options or file, start, and encryption."""

from __future__ import annotations

import http.server
import json
import os
import socket
import ssl
import subprocess
import sys
import threading
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path
from typing import Any, ClassVar
from urllib.parse import urlsplit

import dask.config
import pytest
import yaml
from support.cases import each
from support.servers import loopback

from lidarops.run import clusters


def test_choices_of_the_command_line(tmp_path: Path) -> None:
    assert clusters.choose_cluster() == clusters.Local(workers=1)
    assert clusters.choose_cluster(workers=3) == clusters.Local(workers=3)
    assert clusters.choose_cluster(scheduler="tls://head:8786").kind == "scheduler"
    assert clusters.choose_cluster(cluster="slurm") == clusters.Slurm()
    assert clusters.choose_cluster(cluster="kubernetes", workers=9) == clusters.Kubernetes(
        workers=9
    )
    described = tmp_path / "cluster.yaml"
    described.write_text("{kind: slurm, queue: long, memory: 3 GiB}")
    assert clusters.choose_cluster(cluster=str(described)) == clusters.Slurm(
        queue="long", memory="3 GiB"
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{kind: slurn}", "'local', 'scheduler', 'slurm', 'kubernetes'"),
        ("{workers: 3}", "kind"),
        ("{kind: slurm, workers: 0}", "workers: Input should be greater than or equal to 1"),
        ("{kind: slurm, wallclock: 4}", "wallclock: Extra inputs are not permitted"),
        ("{kind: slurm, walltime: 4}", "walltime"),
        ("{kind: local, memory: 2}", "memory"),
        ("{kind: scheduler, address: 'head'}", "address"),
        ("[slurm]", "is not a mapping"),
        ("{kind: slurm, kind: local}", "kind: given twice, in lines 1 and 1"),
        ("{kind: [", "cannot be read"),
    ],
)
def test_a_wrong_description_is_reported_with_file_and_field(
    tmp_path: Path, text: str, message: str
) -> None:
    described = tmp_path / "cluster.yaml"
    described.write_text(text)
    with pytest.raises(clusters.ClusterError, match=r"cluster\.yaml") as caught:
        clusters.choose_cluster(cluster=str(described))
    assert message in str(caught.value)


@each(
    ("choice", "message"),
    [
        ({"scheduler": "tcp://head:8786", "workers": 2}, "has its own workers"),
        ({"cluster": "no-such.yaml"}, "cannot be read"),
        ({"scheduler": "nowhere"}, "such as tls://head:8786"),
        ({"scheduler": "tcp://head:8786"}, "without encryption.*unencrypted: true"),
        ({"scheduler": "tcp://192.0.2.7:8786"}, "without encryption"),
        ({"scheduler": "tcp://127.0.0.1.example.org:8786"}, "without encryption"),
        ({"scheduler": "tcp://[2001:db8::1]:8786"}, "without encryption"),
        ({"scheduler": "tls://head:8786", "memory": "2GiB"}, "memory_limit: .*of this machine"),
        ({"cluster": "slurm", "memory": "2GiB"}, "memory_limit: .*of this machine"),
    ],
)
def test_a_contradictory_choice_is_wrong_use(choice: dict[str, Any], message: str) -> None:
    with pytest.raises(clusters.ClusterError, match=message) as caught:
        clusters.choose_cluster(**choice)
    assert caught.value.wrong_use


def test_a_scheduler_without_encryption_is_used_on_this_machine_or_by_name(tmp_path: Path) -> None:
    for host in ("127.0.0.1", "localhost", "[::1]"):
        assert clusters.choose_cluster(scheduler=f"tcp://{host}:8786").kind == "scheduler"
    described = tmp_path / "cluster.yaml"
    for kind in ("scheduler", "kubernetes"):
        text = f'kind: {kind}\naddress: "tcp://head:8786"\n'
        described.write_text(text)
        with pytest.raises(clusters.ClusterError, match=r"address: .*without encryption"):
            clusters.choose_cluster(cluster=str(described))
        described.write_text(f"{text}unencrypted: true\n")
        assert clusters.choose_cluster(cluster=str(described)).kind == kind


def test_a_memory_limit_applies_to_local_workers(tmp_path: Path) -> None:
    assert clusters.choose_cluster(memory="2GiB") == clusters.Local(memory="2GiB")
    described = tmp_path / "cluster.yaml"
    described.write_text("{kind: local, workers: 3, memory: 1GiB}")
    chosen = clusters.choose_cluster(cluster=str(described), memory="2GiB")
    assert chosen == clusters.Local(workers=3, memory="2GiB")


def where() -> tuple[int, str | None]:
    return os.getpid(), os.environ.get("OMP_NUM_THREADS")


@pytest.mark.slow
def test_local_workers_are_processes_of_one_thread_on_loopback() -> None:
    chosen = clusters.Local(workers=2, memory="600MiB")
    with clusters.connect_client(chosen) as client:
        about = client.scheduler_info()["workers"]
        assert {each["nthreads"] for each in about.values()} == {1}
        assert {each["memory_limit"] for each in about.values()} == {600 * 2**20}
        assert all(address.startswith("tls://127.0.0.1:") for address in about)
        process, threads = client.submit(where).result()
        assert process != os.getpid()
        assert threads == "1"


def test_local_clusters_refuse_whoever_has_no_certificate_of_the_run() -> None:
    """Any user of a machine reaches its loopback, and can run code where a scheduler lets him."""
    with clusters.connect_client(clusters.Local(workers=1)) as client:
        workers = client.scheduler_info()["workers"]
        stranger = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        stranger.check_hostname = False
        stranger.verify_mode = ssl.CERT_NONE
        nannies = [each["nanny"] for each in workers.values()]
        for address in (client.scheduler.address, *workers, *nannies):
            place = urlsplit(address)
            with (
                socket.create_connection((place.hostname, place.port)) as plain,
                stranger.wrap_socket(plain) as connection,
                pytest.raises(ssl.SSLError, match="certificate required"),
            ):
                connection.recv(1)


def test_an_absent_scheduler_is_reported() -> None:
    address = f"tcp://127.0.0.1:{loopback.free_port()}"
    with (
        pytest.raises(clusters.ClusterError, match="no scheduler cluster") as caught,
        clusters.connect_client(clusters.Scheduler(address=address, wait=1.0)),
    ):
        raise AssertionError("the client was given")
    # It may be restarted.
    assert not caught.value.wrong_use


FILES = {
    "authority.crt": "ca.crt",
    "authority.key": "ca.key",
    "cluster.crt": "tls.crt",
    "cluster.key": "tls.key",
}


def dask_settings(folder: Path) -> dict[str, str]:
    """Return the variables that deploy/kubernetes sets, for certificates in another folder."""
    documents = (loopback.REPOSITORY / "deploy" / "kubernetes" / "base.yaml").read_text()
    (settings,) = (
        each["data"] for each in yaml.safe_load_all(documents) if each["kind"] == "ConfigMap"
    )
    return {
        name: value.replace("/tls/", f"{folder}/")
        for name, value in settings.items()
        if name.startswith("DASK_")
    }


def certificates(folder: Path, host: str = "127.0.0.1") -> clusters.Tls:
    """Make an authority and a signed certificate, as docs/howto/cluster.md does with openssl."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    now = datetime.now(UTC)
    keys = {name: ec.generate_private_key(ec.SECP256R1()) for name in ("authority", "cluster")}
    names = {name: x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, name)]) for name in keys}
    for name, key in keys.items():
        certificate = (
            x509.CertificateBuilder()
            .subject_name(names[name])
            .issuer_name(names["authority"])
            .public_key(key.public_key())
            .serial_number(x509.random_serial_number())
            .not_valid_before(now - timedelta(hours=1))
            .not_valid_after(now + timedelta(hours=1))
            .add_extension(
                x509.BasicConstraints(ca=name == "authority", path_length=None), critical=True
            )
            .add_extension(
                x509.SubjectAlternativeName([x509.IPAddress(ip_address(host))]), critical=False
            )
            .sign(keys["authority"], hashes.SHA256())
        )
        (folder / FILES[f"{name}.crt"]).write_bytes(
            certificate.public_bytes(serialization.Encoding.PEM)
        )
        secret = key.private_bytes(
            serialization.Encoding.PEM,
            serialization.PrivateFormat.PKCS8,
            serialization.NoEncryption(),
        )
        (folder / FILES[f"{name}.key"]).write_bytes(secret)
    return clusters.Tls(
        ca=folder / "ca.crt",
        certificate=folder / "tls.crt",
        key=folder / "tls.key",
    )


@pytest.fixture
def encrypted(tmp_path: Path) -> Iterator[tuple[str, clusters.Tls]]:
    """A scheduler and a worker as deploy/kubernetes starts them, on loopback."""
    tls = certificates(tmp_path)
    port = loopback.free_port()
    address = f"tls://127.0.0.1:{port}"
    commands = [
        ["scheduler", "--protocol=tls", "--host=127.0.0.1", f"--port={port}", "--no-dashboard"],
        ["worker", address, "--nthreads=1", "--memory-limit=1GiB", "--host=127.0.0.1"],
    ]
    log = (tmp_path / "dask.log").open("wb")
    running = [
        subprocess.Popen(
            [sys.executable, "-m", "dask", *command],
            stdout=log,
            stderr=log,
            cwd=tmp_path,
            env={**os.environ, **dask_settings(tmp_path)},
        )
        for command in commands
    ]
    try:
        loopback.wait_until(lambda: loopback.listens(port), 60, "the scheduler does not listen")
        yield address, tls
    finally:
        for process in running:
            loopback.kill_tree(process)
        log.close()


def test_tls_keeps_strangers_out(encrypted: tuple[str, clusters.Tls], tmp_path: Path) -> None:
    address, tls = encrypted
    with clusters.connect_client(clusters.Scheduler(address=address, tls=tls)) as client:
        assert client.submit(sum, [1, 2]).result() == 3
        assert all(
            each.startswith("tls://127.0.0.1") for each in client.scheduler_info()["workers"]
        )
    settings = dask.config.merge(
        dask.config.config, dask.config.collect_env(dask_settings(tmp_path))
    )
    with (
        dask.config.set(settings),
        clusters.connect_client(clusters.Scheduler(address=address)) as client,
    ):
        assert client.submit(sum, [2, 2]).result() == 4
    strangers = tmp_path / "strangers"
    strangers.mkdir()
    plain = clusters.Scheduler(address=address.replace("tls", "tcp"), wait=2.0)
    other = clusters.Scheduler(address=address, tls=certificates(strangers), wait=2.0)
    for stranger in (plain, other):
        with (
            pytest.raises(clusters.ClusterError, match="no scheduler cluster"),
            clusters.connect_client(stranger),
        ):
            raise AssertionError("a stranger was let in")


class FakeApi(http.server.BaseHTTPRequestHandler):
    """A stand-in for the Kubernetes API that scales deployments."""

    seen: ClassVar[list[tuple[str, str, Any]]] = []
    status = 200

    def do_PATCH(self) -> None:
        body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        assert self.headers["Content-Type"] == "application/merge-patch+json"
        self.seen.append((self.path, self.headers["Authorization"], body["spec"]["replicas"]))
        self.send_response(self.status)
        self.end_headers()
        self.wfile.write(b"{}" if self.status == 200 else b'{"message": "forbidden: user"}')

    def log_message(self, *args: object) -> None:
        """Do not log."""


@pytest.fixture
def api(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[str]:
    monkeypatch.setattr(FakeApi, "seen", [])
    monkeypatch.setattr(FakeApi, "status", 200)
    monkeypatch.setattr(clusters, "IDENTITY", tmp_path)
    (tmp_path / "token").write_text("secret\n")
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), FakeApi) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def test_kubernetes_workers_are_scaled_up_and_down(api: str) -> None:
    class Interrupted(Exception):  # noqa: N818 - no error
        pass

    with (
        pytest.raises(Interrupted),
        clusters.scaled_deployment(api, "lidarops", "lidarops-worker", replicas=7),
    ):
        raise Interrupted
    path = "/apis/apps/v1/namespaces/lidarops/deployments/lidarops-worker/scale"
    assert FakeApi.seen == [(path, "Bearer secret", 7), (path, "Bearer secret", 0)]


def test_a_refusal_by_kubernetes_is_reported(api: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(FakeApi, "status", 403)
    with (
        pytest.raises(clusters.ClusterError, match=r"403 .*forbidden: user"),
        clusters.connect_client(clusters.Kubernetes(api=api)),
    ):
        raise AssertionError("the client was given")
