"""Start or reach the workers that process scenes: local, a dask scheduler, Slurm or Kubernetes.

A cluster is named on the command line or described by a small YAML file. Each worker has one
thread, because netCDF4 writes from only one thread of a process, and BLAS and numba gain nothing
from more. Workers need the software and access to the archive and the folder of products.
"""

from __future__ import annotations

import importlib.util
import json
import logging
import signal
import ssl
import threading
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from http.client import HTTPConnection, HTTPException, HTTPSConnection
from ipaddress import ip_address
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal
from urllib.parse import urlsplit

import dask.config
import yaml
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    TypeAdapter,
    ValidationError,
    ValidationInfo,
    field_validator,
)

from lidarops.campaign.yaml_errors import Loader, duplicate_keys
from lidarops.errors import LidarOpsError
from lidarops.system.processes import keep_memory, start_method

if TYPE_CHECKING:
    from distributed import Client, Security

WORKER_TIMEOUT: Final = 120.0
"""s without any worker after which a warning is logged; local workers are then considered lost."""
MALLOC_TRIM_VARIABLE: Final = "MALLOC_TRIM_THRESHOLD_"
"""Environment variable by which dask makes the C library return small pieces of memory at once."""
_DASK: Final = {
    # This module counts the deaths of workers, per scene.
    "distributed.scheduler.allowed-failures": 0,
    # A worker that gives no sign of life, such as a stopped process, is replaced.
    "distributed.scheduler.worker-ttl": f"{WORKER_TIMEOUT:g}s",
    # With it, small scenes spend much of their time on mapping and returning every array.
    f"distributed.nanny.pre-spawn-environ.{MALLOC_TRIM_VARIABLE}": None,
}
_WITHOUT_PAGES: Final = {
    # Profiling would wake every process 100 times a second, and the tick 50 times, for a dashboard
    # that is not served.
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "500ms",
    # Pages that any user of the machine could read.
    "distributed.scheduler.http.routes": [],
    # For the same dashboard, each process would read a dozen system files twice a second.
    "distributed.admin.system-monitor.interval": "10s",
}

_SILENCED: Final = (
    "distributed.scheduler",
    "distributed.nanny",
    "distributed.worker.state_machine",
)
"""Loggers that report, partly in tracebacks, what lidarops reports itself: workers that died, and
abandoned scenes. Another logger warns about the memory of a worker, and stays."""
IDENTITY = Path("/var/run/secrets/kubernetes.io/serviceaccount")
"""Folder in which Kubernetes gives a pod its ``token`` and the API's ``ca.crt``."""
_API_TIMEOUT: Final = 30.0
"""s."""

_LOG = logging.getLogger(__name__)

Memory = Annotated[str, Field(pattern=r"^\d+(\.\d+)? ?[KMGT]i?B$", description="such as 2GiB")]
Name = Annotated[str, Field(pattern=r"^[a-z0-9]([-a-z0-9.]*[a-z0-9])?$", max_length=63)]
Workers = Annotated[int, Field(ge=1, le=10_000)]
Seconds = Annotated[float, Field(gt=0, le=86_400, allow_inf_nan=False)]
_ENVIRONMENT = (
    f"""export DASK_DISTRIBUTED__NANNY__PRE_SPAWN_ENVIRON="{{'{MALLOC_TRIM_VARIABLE}': None}}\""""
)


class ClusterError(LidarOpsError):
    """A cluster is described wrongly, cannot be started or reached, or is lost."""

    unavailable = True


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Tls(_Model):
    """TLS certificates of a dask cluster.

    Without them, anyone who reaches the scheduler can run code on the cluster.
    """

    ca: Path = Field(
        description="certificate of the authority that signed the cluster's certificate"
    )
    certificate: Path
    key: Path


class Local(_Model):
    """Processes on this machine, reachable from this machine only."""

    kind: Literal["local"] = "local"
    workers: Workers = 1
    memory: Memory | None = Field(
        default=None,
        description="memory limit of a worker; default an equal share of the machine's memory",
    )


class _Reached(_Model):
    """A scheduler that runs already."""

    # Before the address, whose check reads it.
    unencrypted: bool = Field(
        default=False, description="whether tcp:// is admitted for a scheduler of another machine"
    )
    address: str
    tls: Tls | None = Field(default=None, description="default: the settings of dask")

    @field_validator("address")
    @classmethod
    def _refuse_plain_tcp(cls, address: str, others: ValidationInfo) -> str:
        place = urlsplit(address)
        plain = place.scheme == "tcp" and not _is_loopback(place.hostname)
        if plain and not others.data.get("unencrypted", False):
            raise ValueError(
                f"{address} is another machine without encryption: whoever answers there gets the"
                " scenes, and can run code here; in a network that you trust, set unencrypted: true"
                " in a cluster file"
            )
        return address


def _is_loopback(host: str | None) -> bool:
    try:
        return host == "localhost" or ip_address(host or "").is_loopback
    except ValueError:
        return False


class Scheduler(_Reached):
    """A running dask scheduler with its own workers."""

    kind: Literal["scheduler"] = "scheduler"
    address: str = Field(pattern=r"^(tcp|tls)://[^/\s]+:\d+$")
    wait: Seconds = Field(default=60.0, description="s to wait for the first worker")


class Slurm(_Model):
    """Workers as Slurm jobs; unless given, certificates are made for the time of the run."""

    kind: Literal["slurm"] = "slurm"
    workers: Workers = 4
    memory: Memory = "2GiB"
    queue: str | None = None
    account: str | None = None
    walltime: str = Field(default="04:00:00", pattern=r"^(\d+-)?\d{1,2}:\d{2}:\d{2}$")
    interface: str | None = Field(
        default=None, description="network interface of scheduler and workers, such as ib0"
    )
    folder: Path = Field(
        default=Path("slurm"), description="folder on all nodes, for certificates and logs"
    )
    prologue: tuple[str, ...] = Field(
        default=(), description="shell lines to run before the worker"
    )
    directives: tuple[str, ...] = Field(default=(), description="further #SBATCH options")
    tls: Tls | None = None
    wait: Seconds = Field(default=3600.0, description="s to wait for the first worker in the queue")


class Kubernetes(_Reached):
    """The scheduler and the workers of ``deploy/kubernetes``, scaled up for the time of the run."""

    kind: Literal["kubernetes"] = "kubernetes"
    workers: Workers = 4
    address: str = Field(default="tls://lidarops-scheduler:8786", pattern=r"^(tcp|tls)://\S+:\d+$")
    namespace: Name = "lidarops"
    deployment: Name = "lidarops-worker"
    api: str = Field(default="https://kubernetes.default.svc", pattern=r"^https?://[^/\s]+$")
    wait: Seconds = Field(
        default=600.0, description="s to wait for the first worker, e.g. while nodes start"
    )


Cluster = Local | Scheduler | Slurm | Kubernetes
_ADAPTER: TypeAdapter[Cluster] = TypeAdapter(Annotated[Cluster, Field(discriminator="kind")])
_KINDS = ("local", "slurm", "kubernetes")


def choose_cluster(
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    cluster: str | None = None,
    memory: str | None = None,
) -> Cluster:
    """Return the cluster that the command-line options describe.

    Parameters
    ----------
    workers : int, optional
        Number of local processes; with `cluster`, of its workers.
    scheduler : str, optional
        Address of a dask scheduler, such as ``tls://head:8786``.
    cluster : str, optional
        ``slurm`` or ``kubernetes`` with the defaults of `Slurm` or `Kubernetes`, or the path of a
        YAML file that describes one.
    memory : str, optional
        Memory limit of a local worker, such as ``2GiB``; other clusters set it themselves.

    Raises
    ------
    ClusterError
        If options contradict each other or the description is invalid (wrong use).
    """
    if scheduler is not None:
        if cluster is not None or workers is not None:
            raise ClusterError(
                "a running scheduler has its own workers",
                field="--scheduler",
                remedy="give --scheduler alone, or --cluster and --workers",
                wrong_use=True,
            )
        chosen = _validate({"kind": "scheduler", "address": scheduler}, None)
    else:
        settings = {"kind": "local"} if cluster is None else _read_description(cluster)
        settings |= {} if workers is None else {"workers": workers}
        chosen = _validate(settings, None if cluster in (None, *_KINDS) else cluster)
    if memory is None:
        return chosen
    if not isinstance(chosen, Local):
        raise ClusterError(
            "applies only to workers of this machine",
            field="memory_limit",
            remedy="set the memory in the cluster file, or where the workers are started",
            wrong_use=True,
        )
    return chosen.model_copy(update={"memory": memory})


def _read_description(cluster: str) -> dict[str, Any]:
    if cluster in _KINDS:
        return {"kind": cluster}
    raw = None
    try:
        text = Path(cluster).read_text(encoding="utf-8")
        problem = "; ".join(duplicate_keys(yaml.compose(text, Loader=yaml.SafeLoader)))
        raw = Loader(text).get_single_data()
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        problem = f"cannot be read: {error}"
    if problem or not isinstance(raw, dict):
        raise ClusterError(
            problem or "is not a mapping",
            file=cluster,
            remedy="give slurm, kubernetes, or a YAML file such as deploy/slurm/cluster.yaml",
            wrong_use=True,
        )
    return raw


def _validate(settings: dict[str, Any], file: str | None) -> Cluster:
    try:
        return _ADAPTER.validate_python(settings)
    except ValidationError as error:
        problems = [
            f"{'.'.join(str(key) for key in problem['loc'][1:]) or 'kind'}:"
            f" {problem['msg'].removeprefix('Value error, ')}"
            for problem in error.errors(include_url=False)
        ]
        in_address = any("address" in problem["loc"] for problem in error.errors())
        raise ClusterError(
            "; ".join(problems),
            file=file,
            remedy="give the address of a scheduler, such as tls://head:8786"
            if in_address
            else "see lidarops/run/clusters.py for all keys and their limits",
            wrong_use=True,
        ) from error


@contextmanager
def connect_client(cluster: Cluster) -> Iterator[Client]:
    """Start or reach a cluster; stop at the end of the context what was started.

    Parameters
    ----------
    cluster : Cluster
        From `choose_cluster`, or constructed directly.

    Yields
    ------
    distributed.Client
        With at least one worker. Scenes fail on workers with other code of lidarops.

    Raises
    ------
    ClusterError
        If the cluster cannot be started or reached in time.
    """
    with ExitStack() as stack:
        try:
            client = _connect(cluster, stack)
        # The cluster is absent, refuses, or is configured wrongly.
        except (OSError, RuntimeError, ValueError, TypeError) as error:
            raise ClusterError(
                f"no {cluster.kind} cluster: {error!r}",
                field="cluster",
                remedy=_REMEDIES[cluster.kind],
            ) from error
        yield client


def _connect(cluster: Cluster, stack: ExitStack) -> Client:
    from distributed import Client  # noqa: PLC0415 - takes a second to import

    if isinstance(cluster, Local):
        return stack.enter_context(local_client(cluster.workers, memory=cluster.memory))
    address: Any
    options: dict[str, Any] = {}
    if isinstance(cluster, Slurm):
        # The executor counts the deaths of workers, per scene.
        stack.enter_context(dask.config.set({"distributed.scheduler.allowed-failures": 0}))
        address = stack.enter_context(_slurm(cluster))
    else:
        address = cluster.address
        options = {"security": _security(cluster.tls), "timeout": cluster.wait}
    if isinstance(cluster, Kubernetes):
        place = (cluster.api, cluster.namespace, cluster.deployment)
        stack.enter_context(scaled_deployment(*place, replicas=cluster.workers))
    client: Client = stack.enter_context(Client(address, **options))
    client.wait_for_workers(1, timeout=cluster.wait)
    return client


_REMEDIES = {
    "local": "start fewer workers, or give them more memory",
    "scheduler": "check that the scheduler and a worker run, and the certificates for tls://",
    "slurm": "see squeue, and the logs in the folder of the cluster",
    "kubernetes": "see kubectl get pods, and check that the role of deploy/kubernetes is bound",
}


def _slurm(cluster: Slurm) -> Any:
    try:
        from dask_jobqueue.slurm import SLURMCluster  # noqa: PLC0415 - optional
    except ImportError as error:
        raise ClusterError(
            "dask-jobqueue is not installed", remedy="pip install lidarops[slurm]"
        ) from error
    folder = cluster.folder.absolute()
    folder.mkdir(parents=True, exist_ok=True)
    jobs = SLURMCluster(
        cores=1,
        processes=1,
        memory=cluster.memory,
        queue=cluster.queue,
        account=cluster.account,
        walltime=cluster.walltime,
        interface=cluster.interface,
        # Anyone who reaches a scheduler without certificates can run code as its user.
        security=_security(cluster.tls) or True,
        shared_temp_directory=str(folder),
        log_directory=str(folder),
        job_script_prologue=[_ENVIRONMENT, *cluster.prologue],
        job_extra_directives=list(cluster.directives),
        scheduler_options={"dashboard": False, "dashboard_address": None},
    )
    # Keep this number, also after a job is cancelled or a node is lost.
    jobs.adapt(minimum_jobs=cluster.workers, maximum_jobs=cluster.workers)
    return jobs


def _security(tls: Tls | None) -> Security | None:
    from distributed import Security  # noqa: PLC0415 - takes a second to import

    if tls is None:
        return None
    files = {"cert": str(tls.certificate), "key": str(tls.key)}
    return Security(
        require_encryption=True,
        tls_ca_file=str(tls.ca),
        **{
            f"tls_{role}_{name}": path
            for role in ("scheduler", "worker", "client")
            for name, path in files.items()
        },
    )


@contextmanager
def local_client(
    workers: int, *, memory: str | None = None, dashboard: bool = False
) -> Iterator[Client]:
    """Start a dask cluster of single-threaded processes on this machine.

    netCDF4 writes from only one thread of a process, and BLAS and numba gain nothing from more.
    Only processes that hold its certificate, made for this run, can use the cluster.

    Parameters
    ----------
    workers : int
    memory : str, optional
        Memory limit of a worker, such as ``2GiB``; default an equal share of the machine's memory.
        A worker that exceeds it is restarted, and its scene is tried again.
    dashboard : bool, optional
        Whether to serve the pages of dask, which any user of this machine can read.

    Raises
    ------
    ClusterError
        If the pages need a package that is not installed.
    """
    if dashboard and importlib.util.find_spec("bokeh") is None:
        raise ClusterError("the pages of dask need bokeh", remedy="pip install lidarops[dashboard]")
    from distributed import Client, LocalCluster  # noqa: PLC0415 - takes a second to import

    started = {"distributed.worker.multiprocessing-method": start_method()}
    with (
        _quiet(),
        dask.config.set(started | ({} if dashboard else _WITHOUT_PAGES) | _DASK),
        LocalCluster(
            # Workers start below: a signal during the start here would leave an unclosed cluster.
            n_workers=0,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            # With certificates of this run: any user of the machine reaches its loopback, and who
            # reaches a scheduler can run code on its workers.
            security=True,
            dashboard_address="127.0.0.1:0" if dashboard else None,
            # Without a dashboard dask still serves HTTP, by default on all interfaces.
            scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},
            memory_limit=memory or "auto",
            preload=__name__,
        ) as cluster,
        Client(cluster) as client,
    ):
        cluster.scale(workers)
        _await_workers(client, workers)
        yield client


def _await_workers(client: Client, workers: int) -> None:
    """Wait for starting workers; go on with fewer if some do not start."""
    try:
        client.wait_for_workers(workers, timeout=WORKER_TIMEOUT)
    except TimeoutError as error:
        started = len(client.nthreads())
        if not started:
            raise ClusterError(
                f"no worker started within {WORKER_TIMEOUT:.0f} s",
                remedy="give each worker more memory, or start fewer",
            ) from error
        _LOG.warning("%d of %d workers started within %.0f s", started, workers, WORKER_TIMEOUT)


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence the loggers of dask that repeat what lidarops reports."""
    before = {name: logging.getLogger(name).level for name in _SILENCED}
    _set_levels(dict.fromkeys(before, logging.CRITICAL))
    try:
        yield
    finally:
        _set_levels(before)


def _set_levels(levels: Mapping[str, int]) -> None:
    for name, level in levels.items():
        logging.getLogger(name).setLevel(level)


def dask_setup(_worker: object) -> None:
    """Prepare a worker; dask calls a function of this name."""
    _set_levels(dict.fromkeys(_SILENCED, logging.CRITICAL))
    keep_memory()
    # Ctrl-C reaches all processes of a terminal, but workers should finish their scenes.
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextmanager
def scaled_deployment(
    api: str, namespace: str, deployment: str, *, replicas: int
) -> Iterator[None]:
    """Run a Kubernetes deployment with some replicas, with the rights of this pod; at the end none.

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
    address = urlsplit(api)
    connection = HTTPConnection(address.netloc, timeout=_API_TIMEOUT)
    if address.scheme == "https":
        context = ssl.create_default_context(cafile=str(IDENTITY / "ca.crt"))
        connection = HTTPSConnection(address.netloc, timeout=_API_TIMEOUT, context=context)
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
