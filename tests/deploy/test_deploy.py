"""What is in deploy/ is in step with the code, and valid for the tools that read it."""

import json
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest
import yaml
import zenoh

from ldo_service.client import connect
from ldo_service.commands import cli
from ldo_service.commands.keys import router_yaml
from ldo_service.schemas import encode
from ldo_service.schemas.pose import IDENTITY
from ldo_service.schemas.topics import CONTROL, ODOMETRY_PRIOR, TOPICS
from ldo_service.service.metrics import HealthCollector
from ldo_service.service.metrics import serve_metrics as exporting
from ldo_service.transport.access_control import read_access, rules_of
from ldo_service.transport.certificate_authority import CertificateAuthority
from tests.ports import free_port
from tests.schemas.examples import EXAMPLES

DEPLOY = Path(__file__).parent.parent.parent / "deploy"
UNIT = DEPLOY / "ldo@.service"
PIN = re.compile(r"eclipse/zenoh:(\d+\.\d+)\.\d+")


def documents(name: str) -> list[Any]:
    return list(yaml.safe_load_all((DEPLOY / name).read_text()))


def needs(tool: str) -> str:
    path = shutil.which(tool)
    if path is None:
        pytest.skip(f"needs {tool} on the PATH")
    return path


@pytest.fixture
def port() -> int:
    return free_port()


# --- the router -----------------------------------------------------------------------------------
def test_the_example_of_a_router_is_what_ldo_keys_writes() -> None:
    """Mend it with `ldo keys router deploy/example > deploy/example/router.yaml`."""
    access = read_access(DEPLOY / "example" / "access.yaml")
    written = router_yaml(access, Path("/etc/ldo/keys"), 7447)
    assert (DEPLOY / "example" / "router.yaml").read_text() == written


def test_every_topic_has_somebody_who_may_put_and_somebody_who_may_read() -> None:
    def keys(role: Any, message: str) -> set[str]:
        rules = [rule for rule in rules_of(role) if message in rule.messages]
        return {key for rule in rules for key in rule.keys}

    assert keys("service", "put") == keys("service", "declare_subscriber") == {"**"}
    readable = {topic.subscription_key for topic in TOPICS}
    for role in ("viewer", "operator"):
        assert keys(role, "declare_subscriber") == readable - {CONTROL.name}
    assert CONTROL.name in keys("operator", "query")
    assert CONTROL.name not in keys("viewer", "query")


def test_a_router_of_its_own_serves_those_whom_the_file_names(tmp_path: Path) -> None:
    """The file is given to Zenoh as `zenohd --config` takes it."""
    authority = CertificateAuthority.new(tmp_path / "keys", days=2)
    for name, role in (("router", "service"), ("wheels", "odometry"), ("desk", "viewer")):
        authority.add(name, role, "*", days=1)
    port = free_port()
    access = read_access(authority.folder / "access.yaml")
    file = tmp_path / "router.yaml"
    file.write_text(router_yaml(access, authority.folder / "router", port))
    here = f"tls/127.0.0.1:{port}"
    with (
        zenoh.open(zenoh.Config.from_file(str(file))),
        connect("mule", here, authority.folder / "desk") as desk,
        connect("mule", here, authority.folder / "wheels") as wheels,
    ):
        for message in follow(desk, wheels):
            assert message.T_prior_base == IDENTITY
            break


def follow(desk: Any, wheels: Any) -> Iterator[Any]:
    with desk.poller(ODOMETRY_PRIOR.name, ODOMETRY_PRIOR.message) as inbox:
        while True:
            wheels.publish_prior(IDENTITY, stamp_ns=1)
            yield from inbox()


# --- metrics --------------------------------------------------------------------------------------
def exported() -> dict[str, set[str]]:
    """Labels of each sample that Prometheus gets, by its name."""
    collector = HealthCollector("mule")
    collector.on_health(b"", memoryview(encode(EXAMPLES["health"])))
    samples = [sample for family in collector.collect() for sample in family.samples]
    return {sample.name: set(sample.labels) for sample in samples}


def shown() -> list[str]:
    dashboard = json.loads((DEPLOY / "grafana.json").read_text())
    return [target["expr"] for panel in dashboard["panels"] for target in panel["targets"]]


def test_the_dashboard_shows_every_metric_by_labels_that_it_has() -> None:
    known, used = exported(), set()
    for expression in shown():
        ((name, selector),) = re.findall(r"(ldo_\w+)\{([^}]*)\}", expression)
        used.add(name)
        labels = set(re.findall(r"(\w+)=", selector))
        assert labels <= known[name], expression
    assert used == set(known) - {"ldo_paused", "ldo_input_messages_total", "ldo_input_gaps_total"}


def test_prometheus_asks_where_the_unit_exports() -> None:
    (config,) = documents("prometheus.yaml")
    (target,) = config["scrape_configs"][0]["static_configs"][0]["targets"]
    assert f"--metrics-port {target.rpartition(':')[2]}" in UNIT.read_text()


# --- commands -------------------------------------------------------------------------------------
def commands() -> Iterator[list[str]]:
    """Every command line of `ldo` in deploy/."""
    (compose,) = documents("compose.yaml")
    for service in compose["services"].values():
        if service["image"] == "ldo-slam" and "entrypoint" not in service:
            yield service["command"]
    for document in documents("kubernetes.yaml"):
        for container in containers(document):
            if container["image"].startswith("ldo-slam:"):
                yield container["args"]
    (line,) = re.findall(r"^ExecStart=\S+/ldo (.*)$", UNIT.read_text(), re.MULTILINE)
    yield line.split()


def containers(document: Any) -> list[Any]:
    return (
        document["spec"]["template"]["spec"]["containers"]
        if "template" in document.get("spec", {})
        else []
    )


@pytest.mark.parametrize("command", list(commands()), ids=lambda command: " ".join(command)[:60])
def test_commands_name_verbs_and_options_that_there_are(
    command: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    verb, *arguments = command
    with pytest.raises(SystemExit):
        cli.main([verb, "--help"])
    known = set(re.findall(r"--[\w-]+", capsys.readouterr().out))
    assert {word.partition("=")[0] for word in arguments if word.startswith("--")} <= known


def test_containers_are_asked_for_their_health_where_they_tell_it(port: int) -> None:
    """The test of compose.yaml itself, against a collector whose actors are silent or not."""
    (compose,) = documents("compose.yaml")
    service = compose["services"]["service"]
    (metrics,) = [
        w.partition("=")[2] for w in service["command"] if w.startswith("--metrics-port=")
    ]
    *_, program = service["healthcheck"]["test"]
    assert f":{metrics}/" in program
    program = program.replace(f":{metrics}/", f":{port}/")
    collector = HealthCollector("mule", ["mapper"])
    with exporting(collector, port):
        assert subprocess.run([sys.executable, "-c", program], capture_output=True).returncode
        collector.on_health(b"", memoryview(encode(EXAMPLES["health"])))
        subprocess.run([sys.executable, "-c", program], check=True)


def test_each_pod_of_the_fleet_sees_the_keys_of_its_own_robot(tmp_path: Path) -> None:
    authority = CertificateAuthority.new(tmp_path / "keys", days=2)
    authority.add("robot-0", "service", "robot-0", days=1)
    made = {path.name for path in (authority.folder / "robot-0").iterdir()}
    (fleet,) = [d for d in documents("kubernetes.yaml") if d["kind"] == "StatefulSet"]
    spec = fleet["spec"]["template"]["spec"]
    (keys,) = [volume for volume in spec["volumes"] if volume["name"] == "keys"]
    sources = [source["secret"] for source in keys["projected"]["sources"]]
    assert len(sources) == fleet["spec"]["replicas"]
    for number, secret in enumerate(sources):
        robot = f"{fleet['metadata']['name']}-{number}"
        assert secret["name"] == f"ldo-{robot}"
        paths = {item["key"]: item["path"] for item in secret["items"]}
        assert paths == {name: f"{robot}/{name}" for name in made}
    ((mount,),) = [
        [m for m in container["volumeMounts"] if m["name"] == "keys"]
        for container in spec["containers"]
    ]
    assert mount["subPathExpr"] == "$(ROBOT)"


def test_the_router_is_of_the_version_that_the_client_is() -> None:
    installed = ".".join(version("eclipse-zenoh").split(".")[:2])
    text = "".join(path.read_text() for path in DEPLOY.glob("*.yaml"))
    assert set(PIN.findall(text)) == {installed}


def test_every_dependency_has_a_least_and_a_most() -> None:
    project = tomllib.loads((DEPLOY.parent / "pyproject.toml").read_text())["project"]
    extras = [one for extra in project["optional-dependencies"].values() for one in extra]
    for dependency in (*project["dependencies"], *extras):
        assert re.fullmatch(r"[\w-]+>=[\d.]+,<[\d.]+", dependency)


# --- tools ----------------------------------------------------------------------------------------
def test_systemd_takes_the_unit(tmp_path: Path) -> None:
    tool = needs("systemd-analyze")
    unit = UNIT.read_text().replace("/opt/ldo/bin/ldo", sys.executable)  # one that is here
    (tmp_path / "ldo@.service").write_text(unit)
    command = [tool, "verify", "--man=no", str(tmp_path / "ldo@mule.service")]
    (tmp_path / "ldo@mule.service").symlink_to("ldo@.service")
    done = subprocess.run(command, capture_output=True, text=True)
    ours = [line for line in done.stderr.splitlines() if "ldo@" in line]
    assert (done.returncode, ours) == (0, [])


def compose_commands() -> Iterator[list[str]]:
    """Of version 2, which reads the specification that files without a version have."""
    for command in (["docker", "compose"], ["docker-compose"]):
        if shutil.which(command[0]):
            done = subprocess.run([*command, "version"], capture_output=True, text=True)
            if done.returncode == 0 and " 1." not in done.stdout.splitlines()[0]:
                yield command


def test_compose_takes_the_file() -> None:
    command = next(compose_commands(), None)
    if command is None:
        pytest.skip("needs docker-compose, or docker with its plug-in `compose`")
    file = ["--file", str(DEPLOY / "compose.yaml")]
    done = subprocess.run([*command, *file, "config", "--quiet"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_kustomize_takes_the_fleet(tmp_path: Path) -> None:
    tool = needs("kubectl")
    shutil.copyfile(DEPLOY / "kubernetes.yaml", tmp_path / "fleet.yaml")
    (tmp_path / "kustomization.yaml").write_text("resources: [fleet.yaml]\n")
    done = subprocess.run([tool, "kustomize", str(tmp_path)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert len(list(yaml.safe_load_all(done.stdout))) == len(documents("kubernetes.yaml"))


def test_kubernetes_knows_every_field_of_the_fleet() -> None:
    schemas = pytest.importorskip("kubernetes_validate", reason="pip install kubernetes-validate")
    for document in documents("kubernetes.yaml"):
        schemas.validate(document, schemas.latest_version(), strict=True)


def test_what_the_fleet_mounts_is_there() -> None:
    for document in documents("kubernetes.yaml"):
        for container in containers(document):
            spec = document["spec"]
            volumes = {volume["name"] for volume in spec["template"]["spec"]["volumes"]}
            volumes |= {claim["metadata"]["name"] for claim in spec.get("volumeClaimTemplates", ())}
            assert {mount["name"] for mount in container["volumeMounts"]} == volumes
            assert document["spec"]["selector"]["matchLabels"].items() <= (
                spec["template"]["metadata"]["labels"].items()
            )


def test_the_image_is_built_from_stages_and_files_that_there_are() -> None:
    lines = (DEPLOY / "Dockerfile").read_text().splitlines()
    stages = [line.split()[-1] for line in lines if line.startswith("FROM")]
    sources = [line.split()[1] for line in lines if line.startswith("FROM")]
    assert stages == ["build", "base", "cpu"], "the last is what is built by default"
    assert set(sources[2:]) <= set(stages)
    kept = (DEPLOY / "Dockerfile.dockerignore").read_text().splitlines()
    for name in (line[1:] for line in kept if line.startswith("!")):
        assert (DEPLOY.parent / name).exists()
