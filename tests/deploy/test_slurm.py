"""Slurm on one node runs the dask workers; a cancelled worker loses no scene."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path

import pytest
import yaml
from support.archives import raw_archives
from support.servers import loopback

from lidarops.campaign.model import load_campaign
from lidarops.records import RunRecord
from lidarops.run import clusters
from lidarops.run.archive import Options, reprocess

PROGRAMS = ("slurmctld", "slurmd", "munged", "sbatch", "scancel", "squeue")
pytestmark = [pytest.mark.deployment, pytest.mark.timeout(600)]

CONFIGURATION = """\
ClusterName=lidarops
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={controller}
SlurmdPort={node}
CommunicationParameters=NoCtldInAddrAny,NoInAddrAny
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
CryptoType=crypto/munge
SlurmUser=root
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
ReturnToService=2
MpiDefault=none
KillWait=2
NodeName={host} NodeAddr=127.0.0.1 CPUs={cpus} RealMemory=4000 State=UNKNOWN
PartitionName=work Nodes={host} Default=YES MaxTime=INFINITE State=UP
"""


@pytest.fixture
def slurm(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Run munge, controller and node daemon in their own folder."""
    pytest.importorskip("dask_jobqueue")
    if os.geteuid() != 0 or not all(shutil.which(program) for program in PROGRAMS):
        pytest.skip("needs Slurm's and munge's programs, and root to start them")
    folder = Path(tempfile.mkdtemp(prefix="lidarops-slurm-"))
    folder.chmod(0o755)
    for name in ("state", "spool", "munge"):
        (folder / name).mkdir()
    shutil.chown(folder / "munge", "munge", "munge")
    key = folder / "munge" / "key"
    key.write_bytes(os.urandom(1024))
    shutil.chown(key, "munge", "munge")
    key.chmod(0o400)
    host = socket.gethostname().partition(".")[0]
    configuration = CONFIGURATION.format(
        host=host,
        folder=folder,
        controller=loopback.free_port(),
        node=loopback.free_port(),
        cpus=os.cpu_count(),
    )
    (folder / "slurm.conf").write_text(configuration)
    monkeypatch.setenv("SLURM_CONF", str(folder / "slurm.conf"))
    munge = [f"--{kind}-file={folder}/munge/{kind}" for kind in ("key", "log", "pid", "seed")]
    own = [f"--socket={folder}/munge/socket", "--foreground", *munge]
    link = folder / "munge.socket"
    link.symlink_to(folder / "munge" / "socket")
    commands = [
        ["runuser", "-u", "munge", "--", "munged", *own],
        ["slurmctld", "-D", "-i"],
        ["slurmd", "-D", "-N", host],
    ]
    running: list[subprocess.Popen[bytes]] = []
    try:
        for command in commands:
            with (folder / f"{command[0]}.out").open("wb") as log:
                running.append(
                    subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True)
                )
            if len(running) == 1:
                loopback.wait_until(link.exists, 30, "munged does not answer", every=0.1)
        loopback.wait_until(idle, 60, "no node is idle")
        yield folder
    finally:
        subprocess.run(["scancel", "--user", "root"], check=False, timeout=60)
        for process in reversed(running):
            loopback.kill_tree(process)
        shutil.rmtree(folder, ignore_errors=True)


def idle() -> bool:
    return "idle" in said("sinfo", "--noheader", "--format=%t")


def said(*command: str) -> str:
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False).stdout


def jobs() -> list[str]:
    return said("squeue", "--noheader", "--format=%i", "--states=RUNNING").split()


def test_a_cancelled_worker_loses_nothing(slurm: Path, tmp_path: Path) -> None:
    campaign = tmp_path / "campaign.yaml"
    campaign.write_text(yaml.safe_dump(many_scenes(tmp_path)))
    settings = load_campaign(campaign)
    expected = digests(reprocess(settings))
    assert len(expected) == 24
    shutil.rmtree(settings.products_root)

    described = tmp_path / "cluster.yaml"
    cluster = {
        "kind": "slurm",
        "workers": 2,
        "memory": "1GiB",
        "queue": "work",
        "interface": "lo",
        "folder": str(tmp_path / "slurm"),
        "prologue": [f"export SLURM_CONF={slurm}/slurm.conf"],
    }
    described.write_text(yaml.safe_dump(cluster))
    cancelled: list[str] = []

    def cancel_one(_: object) -> None:
        if not cancelled and len(running := jobs()) == 2:
            cancelled.append(running[0])
            said("scancel", "--signal=KILL", running[0])
            said("scancel", running[0])

    with clusters.connect_client(clusters.choose_cluster(cluster=str(described))) as client:
        assert client.scheduler.address.startswith("tls://127.0.0.1:")
        client.wait_for_workers(2, timeout=120)
        record = reprocess(
            settings, options=Options(progress=cancel_one, cluster=lambda: nullcontext(client))
        )
        assert cancelled
        loopback.wait_until(lambda: len(jobs()) == 2, 90, "the lost worker was not replaced")
    assert digests(record) == expected
    loopback.wait_until(lambda: not said("squeue", "--noheader"), 60, "the queue is not empty")


def digests(record: RunRecord) -> dict[str, str]:
    return {product.path: product.sha256 for scene in record.scenes for product in scene.products}


def many_scenes(folder: Path) -> dict[str, object]:
    from support import factories

    for minute in range(24):
        raw_archives.write(
            folder / "raw" / "coast" / f"h{minute:02d}", raw_archives.content(minute, bins=4000)
        )
    campaign = factories.campaign().model_dump(mode="json", exclude={"simulation"})
    return {**campaign, "scenes": {"window": "1min"}}
