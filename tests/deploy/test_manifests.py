"""The files in deploy/ are valid, consistent with each other, and expose nothing."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import httpx
import jsonschema
import pytest
import yaml

from flows import maintenance
from lidarops.run import clusters

TEXT = {"type": "string"}
COUNT = {"type": "integer", "minimum": 0}


def exactly(required: str = "", **properties: Any) -> dict[str, Any]:
    """Return the schema of an object with these properties only, so that typing errors fail."""
    return {
        "type": "object",
        "properties": properties,
        "required": required.split(),
        "additionalProperties": False,
    }


def listed(item: dict[str, Any]) -> dict[str, Any]:
    return {"type": "array", "items": item, "minItems": 1}


def source(**more: Any) -> dict[str, Any]:
    return exactly("name", name=TEXT, **more)


NAMES = {"type": "object", "additionalProperties": TEXT}
QUANTITIES = exactly(
    cpu={"type": "string", "pattern": r"^\d+m?$"},
    memory={"type": "string", "pattern": r"^\d+(Mi|Gi)$"},
)
CONTAINER = exactly(
    "name image args envFrom resources securityContext volumeMounts",
    name=TEXT,
    image={"type": "string", "pattern": r"^[a-z0-9./-]+:[a-z0-9.-]+$"},
    args=listed(TEXT),
    envFrom=listed(exactly(configMapRef=source(), secretRef=source(optional={"type": "boolean"}))),
    ports=listed(exactly("containerPort", containerPort=COUNT)),
    readinessProbe=exactly("tcpSocket", tcpSocket=exactly("port", port=COUNT), periodSeconds=COUNT),
    livenessProbe=exactly(
        "periodSeconds failureThreshold",
        httpGet=exactly("path port", path=TEXT, port=COUNT),
        exec=exactly("command", command=listed(TEXT)),
        periodSeconds=COUNT,
        failureThreshold=COUNT,
    ),
    resources=exactly("requests limits", requests=QUANTITIES, limits=QUANTITIES),
    securityContext=exactly(
        "allowPrivilegeEscalation readOnlyRootFilesystem capabilities",
        allowPrivilegeEscalation={"const": False},
        readOnlyRootFilesystem={"const": True},
        capabilities={"const": {"drop": ["ALL"]}},
    ),
    volumeMounts=listed(
        exactly("name mountPath", name=TEXT, mountPath=TEXT, readOnly={"type": "boolean"})
    ),
)
VOLUME = exactly(
    "name",
    name=TEXT,
    emptyDir={"const": {}},
    persistentVolumeClaim=exactly("claimName", claimName=TEXT),
    secret=exactly("secretName", secretName=TEXT, defaultMode={"const": 0o440}),
)
POD = exactly(
    "securityContext containers volumes",
    automountServiceAccountToken={"const": False},
    serviceAccountName=TEXT,
    terminationGracePeriodSeconds=COUNT,
    securityContext=exactly(
        "runAsNonRoot runAsUser runAsGroup fsGroup seccompProfile",
        runAsNonRoot={"const": True},
        runAsUser={"type": "integer", "minimum": 1000},
        runAsGroup={"type": "integer", "minimum": 1000},
        fsGroup={"type": "integer", "minimum": 1000},
        seccompProfile={"const": {"type": "RuntimeDefault"}},
    ),
    containers=listed(CONTAINER),
    volumes=listed(VOLUME),
)
DEPLOYMENT = exactly(
    "replicas selector template",
    replicas=COUNT,
    strategy=exactly("type", type={"enum": ["Recreate", "RollingUpdate"]}),
    selector=exactly("matchLabels", matchLabels=NAMES),
    template=exactly("metadata spec", metadata=exactly("labels", labels=NAMES), spec=POD),
)


@pytest.fixture(scope="module")
def rendered() -> list[dict[str, Any]]:
    if shutil.which("kubectl") is None:
        pytest.skip("needs kubectl, which renders without a cluster")
    folder = Path(__file__).parents[2] / "deploy" / "kubernetes"
    done = subprocess.run(
        ["kubectl", "kustomize", str(folder)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return list(yaml.safe_load_all(done.stdout))


def test_what_reads_the_archive_on_kubernetes_has_the_keys_of_its_store() -> None:
    folder = Path(__file__).parents[2] / "deploy" / "kubernetes"
    containers = {}
    for file in ("dask.yaml", "prefect.yaml"):
        for item in yaml.safe_load_all((folder / file).read_text()):
            if item["kind"] == "Deployment":
                (container,) = item["spec"]["template"]["spec"]["containers"]
                containers[item["metadata"]["name"]] = container
    keys = {"secretRef": {"name": "lidarops-store", "optional": True}}
    reading = {
        name: keys in container["envFrom"]
        for name, container in containers.items()
        if "data" in {mount["name"] for mount in container["volumeMounts"]}
    }
    assert reading == {"lidarops-worker": True, "lidarops-prefect-worker": True}


def test_worker_and_reaper_are_started_again_if_they_hang() -> None:
    folder = Path(__file__).parents[2] / "deploy"
    services = yaml.safe_load((folder / "compose.yaml").read_text())["services"]
    found = list(yaml.safe_load_all((folder / "kubernetes" / "prefect.yaml").read_text()))
    for name, service in (("lidarops-prefect-worker", "worker"), ("lidarops-reaper", "reaper")):
        (container,) = of_kind(found, "Deployment")[name]["spec"]["template"]["spec"]["containers"]
        checks = json.dumps([container["livenessProbe"], services[service]["healthcheck"]])
        for arguments in (container["args"], services[service]["command"]):
            if service == "worker":
                assert "--with-healthcheck" in arguments
                assert checks.count("/health") == checks.count("8080") == 2
            else:
                assert checks.count(arguments[arguments.index("--sign-of-life") + 1]) == 2


def test_the_reaper_shows_that_it_checks_though_the_server_is_away(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def away(**_: object) -> None:
        raise httpx.ConnectError("away")

    def stop(_: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(maintenance, "get_client", away)
    monkeypatch.setattr(maintenance.time, "sleep", stop)
    with pytest.raises(KeyboardInterrupt):
        maintenance.main(every=15.0, sign_of_life=tmp_path / "checked")
    assert (tmp_path / "checked").exists()


def of_kind(rendered: list[dict[str, Any]], kind: str) -> dict[str, dict[str, Any]]:
    return {item["metadata"]["name"]: item for item in rendered if item["kind"] == kind}


def test_deployments_are_well_formed_and_have_no_rights(rendered: list[dict[str, Any]]) -> None:
    deployments = of_kind(rendered, "Deployment")
    assert len(deployments) == 5
    for deployment in deployments.values():
        jsonschema.validate(deployment["spec"], DEPLOYMENT)
        labels = deployment["spec"]["template"]["metadata"]["labels"]
        assert deployment["spec"]["selector"]["matchLabels"] == labels


def test_what_manifests_refer_to_is_there(rendered: list[dict[str, Any]]) -> None:
    known = {kind: of_kind(rendered, kind) for kind in {item["kind"] for item in rendered}}
    readme = (Path(__file__).parents[2] / "docs/howto/cluster.md").read_text()
    for deployment in known["Deployment"].values():
        pod = deployment["spec"]["template"]["spec"]
        volumes = {volume["name"] for volume in pod["volumes"]}
        for container in pod["containers"]:
            assert {mount["name"] for mount in container["volumeMounts"]} == volumes
            for origin in container["envFrom"]:
                if "configMapRef" in origin:
                    assert origin["configMapRef"]["name"] in known["ConfigMap"]
                else:
                    assert f"secret generic {origin['secretRef']['name']} " in readme
        for volume in pod["volumes"]:
            if "persistentVolumeClaim" in volume:
                claim = volume["persistentVolumeClaim"]["claimName"]
                assert claim in known["PersistentVolumeClaim"]
    for name, service in known["Service"].items():
        assert service["spec"]["selector"] == {"app": name}
        assert name in known["Deployment"]
        assert service["spec"].get("type", "ClusterIP") == "ClusterIP"
    assert all(item["metadata"].get("namespace", "lidarops") == "lidarops" for item in rendered)


def test_a_run_may_scale_the_workers_and_nothing_else(rendered: list[dict[str, Any]]) -> None:
    defaults = clusters.Kubernetes()
    assert defaults.namespace in of_kind(rendered, "Namespace")
    assert defaults.deployment in of_kind(rendered, "Deployment")
    host = defaults.address.removeprefix("tls://").partition(":")[0]
    assert host in of_kind(rendered, "Service")
    (role,) = of_kind(rendered, "Role").values()
    assert role["rules"] == [
        {
            "apiGroups": ["apps"],
            "resources": ["deployments/scale"],
            "resourceNames": [defaults.deployment],
            "verbs": ["get", "patch"],
        }
    ]
    worker = of_kind(rendered, "Deployment")[defaults.deployment]
    (container,) = worker["spec"]["template"]["spec"]["containers"]
    assert defaults.address in container["args"]
    assert "--nthreads=1" in container["args"]
    settings = of_kind(rendered, "ConfigMap")["lidarops"]["data"]
    assert settings["DASK_DISTRIBUTED__COMM__REQUIRE_ENCRYPTION"] == "true"


def test_prefect_file(repository: Path) -> None:
    from prefect.cli.deploy._models import PrefectYamlModel

    text = (repository / "deploy" / "prefect.yaml").read_text()
    shipped = PrefectYamlModel.model_validate(yaml.safe_load(text))
    assert {deployment.name for deployment in shipped.deployments} == {
        "demo-nightly",
        "demo-full",
        "demo-catalog",
    }
    for deployment in shipped.deployments:
        assert deployment.tags
        assert "lidarops" in deployment.tags
        assert deployment.enforce_parameter_schema
        assert deployment.concurrency_limit.limit == 1
        path, _, name = deployment.entrypoint.partition(":")
        module = __import__(path.removesuffix(".py").replace("/", "."), fromlist=[name])
        flow = getattr(module, name)
        flow.validate_parameters(deployment.parameters)
        campaign = deployment.parameters.get("campaign")
        assert campaign is None or (repository / campaign).is_file()


def test_compose_publishes_on_loopback_and_keeps_no_secret(repository: Path) -> None:
    composed = yaml.safe_load((repository / "deploy" / "compose.yaml").read_text())
    for name, service in composed["services"].items():
        for port in service.get("ports", []):
            assert port.startswith("127.0.0.1:"), name
        if name != "database":
            assert service["read_only"]
            assert service["cap_drop"] == ["ALL"]
        for value in (service.get("environment") or {}).values():
            assert "PASSWORD" not in value or "${" in value
        for needed in service.get("depends_on", {}):
            assert needed in composed["services"]


def test_container_file(repository: Path) -> None:
    text = (repository / "deploy" / "Containerfile").read_text().replace("\\\n", " ")
    lines = [line for line in text.splitlines() if line and not line.startswith("#")]
    instructions = [line.split(maxsplit=1) for line in lines]
    assert all(word.isupper() for word, _ in instructions)
    bases = [rest for word, rest in instructions if word == "FROM"]
    # A tag moves to other content.
    (pinned,) = (rest for word, rest in instructions if word == "ARG")
    assert re.fullmatch(r"PYTHON=python:3\.\d+-[\w.-]+@sha256:[0-9a-f]{64}", pinned)
    assert all(base.split()[0] == "${PYTHON}" for base in bases)
    user = [rest for word, rest in instructions if word == "USER"][-1]
    assert int(user.partition(":")[0]) >= 1000
    installs = [rest for word, rest in instructions if word == "RUN" and "pip install" in rest]
    assert all("--require-hashes" in rest or "--no-deps" in rest for rest in installs)
    (entry,) = (rest for word, rest in instructions if word == "ENTRYPOINT")
    (command,) = (rest for word, rest in instructions if word == "CMD")
    assert json.loads(entry) == ["python", "-m"]
    run = [sys.executable, "-m", *json.loads(command)]
    result = subprocess.run(run, check=True, capture_output=True, text=True)
    assert "Usage: lidarops" in result.stdout
    ignored = (repository / "deploy" / "Containerfile.dockerignore").read_text().split()
    kept_out = {".git", ".venv", "**/.env*", "**/*.key", "**/*.pem", "**/.aws", "**/.pgpass"}
    assert kept_out <= set(ignored)


PIN = re.compile(r"^([a-z0-9][a-z0-9._-]*)(\[[a-z,]+\])?==(\S+)", re.MULTILINE)


def pins(file: Path) -> set[tuple[str, str]]:
    return {(name, version) for name, _, version in PIN.findall(file.read_text())}


def test_image_pins_what_the_tests_run_with(repository: Path) -> None:
    text = (repository / "deploy" / "requirements.lock").read_text()
    image = pins(repository / "deploy" / "requirements.lock")
    assert pins(repository / "requirements.lock") <= image
    assert image <= pins(repository / "requirements-dev.lock")
    assert {"psycopg", "asyncpg", "s3fs", "dask-jobqueue"} <= {name for name, _ in image}
    assert "://" not in text
    assert all("--hash=sha256:" in block for block in re.split(r"\n(?=[a-z])", text)[1:])


def test_slurm_files(repository: Path) -> None:
    shipped = clusters.choose_cluster(cluster=str(repository / "deploy" / "slurm" / "cluster.yaml"))
    assert shipped.kind == "slurm"
    script = repository / "deploy" / "slurm" / "reprocess.sbatch"
    subprocess.run(["bash", "-n", str(script)], check=True)
    # Slurm makes no folder for it, and a job without it fails without a word.
    (output,) = re.findall(r"^#SBATCH --output=(.*)$", script.read_text(), re.MULTILINE)
    assert "/" not in output
