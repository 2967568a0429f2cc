"""Where scenes are processed: this machine, a running dask scheduler, Slurm or Kubernetes.

A cluster is named on the command line or described by a small YAML file. Workers have one thread
each, since netCDF4 writes from one thread of a process only, and BLAS and numba gain nothing from
more. They need the archive, the folder of products and the software; nothing else is sent to them.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import dask.config
import yaml
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from lidarops.campaign.yaml_errors import duplicate_keys
from lidarops.errors import LidarOpsError
from lidarops.run import kubernetes
from lidarops.run.executor import MALLOC_TRIM_VARIABLE, local_client

if TYPE_CHECKING:
    from distributed import Client, Security

# What a cluster that is absent, refuses or is configured wrongly can raise.
_FAILURES = (OSError, TimeoutError, RuntimeError, ValueError, TypeError)

Memory = Annotated[str, Field(pattern=r"^\d+(\.\d+)? ?[KMGT]i?B$", description="such as 2GiB")]
Name = Annotated[str, Field(pattern=r"^[a-z0-9]([-a-z0-9.]*[a-z0-9])?$", max_length=63)]
Workers = Annotated[int, Field(ge=1, le=10_000)]
Seconds = Annotated[float, Field(gt=0, le=86_400, allow_inf_nan=False)]
_ENVIRONMENT = (
    f"""export DASK_DISTRIBUTED__NANNY__PRE_SPAWN_ENVIRON="{{'{MALLOC_TRIM_VARIABLE}': None}}\""""
)


class ClusterError(LidarOpsError):
    """A cluster that is described wrongly, or cannot be started or reached."""


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Tls(_Model):
    """Certificates of a dask cluster: without them whoever reaches a scheduler runs code on it."""

    ca: Path = Field(description="certificate of the authority that signed the cluster's")
    certificate: Path
    key: Path


class Local(_Model):
    """Processes on this machine, reachable from this machine only."""

    kind: Literal["local"] = "local"
    workers: Workers = 1
    memory: Memory | None = Field(
        default=None, description="of a worker; an equal share of the machine's where not given"
    )


class Scheduler(_Model):
    """A dask scheduler that runs already."""

    kind: Literal["scheduler"] = "scheduler"
    address: str = Field(pattern=r"^(tcp|tls)://[^/\s]+:\d+$")
    tls: Tls | None = Field(default=None, description="the settings of dask itself where not given")
    wait: Seconds = Field(default=60.0, description="s, for a first worker")


class Slurm(_Model):
    """Workers as Slurm jobs; certificates for the time of the run are made unless given."""

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
        default=Path("slurm"), description="shared by all nodes: certificates and logs"
    )
    prologue: tuple[str, ...] = Field(default=(), description="shell lines before the worker")
    directives: tuple[str, ...] = Field(default=(), description="further #SBATCH options")
    tls: Tls | None = None
    wait: Seconds = Field(default=3600.0, description="s, for a first worker: queues are long")


class Kubernetes(_Model):
    """The scheduler and the workers of ``deploy/kubernetes``, scaled up for the time of the run."""

    kind: Literal["kubernetes"] = "kubernetes"
    workers: Workers = 4
    address: str = Field(default="tls://lidarops-scheduler:8786", pattern=r"^(tcp|tls)://\S+:\d+$")
    namespace: Name = "lidarops"
    deployment: Name = "lidarops-worker"
    api: str = Field(default="https://kubernetes.default.svc", pattern=r"^https?://[^/\s]+$")
    tls: Tls | None = Field(default=None, description="the settings of dask itself where not given")
    wait: Seconds = Field(default=600.0, description="s, for a first worker: nodes are started")


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
    """Make the cluster of what stands on a command line.

    Parameters
    ----------
    workers : int, optional
        Processes on this machine; with `cluster` the number of its workers.
    scheduler : str, optional
        Address of a dask scheduler, such as ``tls://head:8786``.
    cluster : str, optional
        ``slurm`` or ``kubernetes`` with the defaults of `Slurm` or `Kubernetes`, or the path of a
        YAML file that describes one.
    memory : str, optional
        Most memory of a worker of this machine, such as ``2GiB``; of others it is told elsewhere.

    Returns
    -------
    Cluster

    Raises
    ------
    ClusterError
        If the choice contradicts itself or is described wrongly: wrong use.
    """
    chosen = _chosen(workers, scheduler, cluster)
    if memory is None:
        return chosen
    if not isinstance(chosen, Local):
        raise ClusterError(
            "is for workers of this machine",
            field="memory_limit",
            remedy="give the memory in the cluster's file, or where its workers are started",
            wrong_use=True,
        )
    return chosen.model_copy(update={"memory": memory})


def _chosen(workers: int | None, scheduler: str | None, cluster: str | None) -> Cluster:
    if scheduler is not None:
        if cluster is not None or workers is not None:
            raise ClusterError(
                "a running scheduler has its own workers",
                field="--scheduler",
                remedy="give --scheduler alone, or --cluster and --workers",
                wrong_use=True,
            )
        return _validated({"kind": "scheduler", "address": scheduler}, None)
    settings: dict[str, Any] = {"kind": "local"} if cluster is None else _described(cluster)
    if workers is not None:
        settings["workers"] = workers
    return _validated(settings, None if cluster in (None, *_KINDS) else cluster)


def _described(cluster: str) -> dict[str, Any]:
    if cluster in _KINDS:
        return {"kind": cluster}
    try:
        text = Path(cluster).read_text(encoding="utf-8")
        twice = duplicate_keys(yaml.compose(text, Loader=yaml.SafeLoader))
        raw = yaml.safe_load(text)
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ClusterError(
            f"cannot be read: {error}",
            file=cluster,
            remedy="give slurm, kubernetes, or the path of a YAML file",
            wrong_use=True,
        ) from error
    if twice:
        raise ClusterError("; ".join(twice), file=cluster, wrong_use=True)
    if not isinstance(raw, dict):
        raise ClusterError(
            "is not a mapping",
            file=cluster,
            remedy="see deploy/slurm/cluster.yaml",
            wrong_use=True,
        )
    return raw


def _validated(settings: dict[str, Any], file: str | None) -> Cluster:
    try:
        return _ADAPTER.validate_python(settings)
    except ValidationError as error:
        told = [
            f"{'.'.join(str(part) for part in each['loc'][1:]) or 'kind'}: {each['msg']}"
            for each in error.errors(include_url=False)
        ]
        addressed = any("address" in each["loc"] for each in error.errors())
        raise ClusterError(
            "; ".join(told),
            file=file,
            remedy="give the address of a scheduler, such as tls://head:8786"
            if addressed
            else "see lidarops/run/clusters.py for every key and its bounds",
            wrong_use=True,
        ) from error


@contextmanager
def connect_client(cluster: Cluster) -> Iterator[Client]:
    """Start or reach a cluster; what was started ends with the context.

    Parameters
    ----------
    cluster : Cluster
        From `choose_cluster`, or made by hand.

    Yields
    ------
    distributed.Client
        With one worker at least. `lidarops.run.executor` refuses those with other code of lidarops.

    Raises
    ------
    ClusterError
        If the cluster cannot be started or reached in time.
    """
    with ExitStack() as stack:
        try:
            connected = _connected(cluster, stack)
        except _FAILURES as error:
            raise ClusterError(
                f"no {cluster.kind} cluster: {error!r}",
                field="cluster",
                remedy=_REMEDIES[cluster.kind],
            ) from error
        yield connected


def _connected(cluster: Cluster, stack: ExitStack) -> Client:
    from distributed import Client  # noqa: PLC0415 - takes a second to import

    if isinstance(cluster, Local):
        return stack.enter_context(local_client(cluster.workers, memory=cluster.memory))
    reached = stack.enter_context(_address(cluster))
    connected: Client = stack.enter_context(Client(reached, **_connection(cluster)))
    connected.wait_for_workers(1, timeout=cluster.wait)
    return connected


_REMEDIES = {
    "local": "ask for fewer workers or more memory",
    "scheduler": "look whether the scheduler and a worker run, and for the certificates of tls://",
    "slurm": "see squeue and the logs in the cluster's folder",
    "kubernetes": "see kubectl get pods; the role of deploy/kubernetes must be bound",
}


@contextmanager
def _address(cluster: Scheduler | Slurm | Kubernetes) -> Iterator[Any]:
    """Give what a `Client` connects to; what had to be started stops with the context."""
    if isinstance(cluster, Scheduler):
        yield cluster.address
    elif isinstance(cluster, Kubernetes):
        with kubernetes.scaled(
            cluster.api, cluster.namespace, cluster.deployment, replicas=cluster.workers
        ):
            yield cluster.address
    else:
        # Every death of a worker is to be seen by the engine, which counts it for its scene.
        with dask.config.set({"distributed.scheduler.allowed-failures": 0}), _slurm(cluster) as own:
            yield own


def _slurm(cluster: Slurm) -> Any:
    try:
        from dask_jobqueue.slurm import SLURMCluster  # noqa: PLC0415 - optional
    except ImportError as error:
        raise ClusterError(
            "dask-jobqueue is not installed", remedy="pip install lidarops[slurm]"
        ) from error
    folder = cluster.folder.absolute()
    folder.mkdir(parents=True, exist_ok=True)
    started = SLURMCluster(
        cores=1,
        processes=1,
        memory=cluster.memory,
        queue=cluster.queue,
        account=cluster.account,
        walltime=cluster.walltime,
        interface=cluster.interface,
        # Whoever reaches a scheduler without certificates runs code as its user.
        security=_security(cluster.tls) or True,
        shared_temp_directory=str(folder),
        log_directory=str(folder),
        job_script_prologue=[_ENVIRONMENT, *cluster.prologue],
        job_extra_directives=list(cluster.directives),
        scheduler_options={"dashboard": False, "dashboard_address": None},
    )
    # As many as are asked for, also after one is cancelled or a node is lost.
    started.adapt(minimum_jobs=cluster.workers, maximum_jobs=cluster.workers)
    return started


def _connection(cluster: Cluster) -> dict[str, Any]:
    if isinstance(cluster, Scheduler | Kubernetes):
        return {"security": _security(cluster.tls), "timeout": cluster.wait}
    return {}


def _security(tls: Tls | None) -> Security | None:
    from distributed import Security  # noqa: PLC0415 - takes a second to import

    if tls is None:
        return None
    parts = {"cert": str(tls.certificate), "key": str(tls.key)}
    return Security(
        require_encryption=True,
        tls_ca_file=str(tls.ca),
        **{
            f"tls_{role}_{part}": path
            for role in ("scheduler", "worker", "client")
            for part, path in parts.items()
        },
    )
