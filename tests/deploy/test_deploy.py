"""Tests that the files in deploy/ match the code and are valid for their tools."""

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec
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
from ldo_service.service.metrics_server import serve_metrics
from ldo_service.transport.access_control import read_access, rules_of
from ldo_service.transport.certificate_authority import CertificateAuthority
from ldo_service.transport.keys import TlsKeys
from tests.ports import free_port
from tests.schemas.examples import EXAMPLES

DEPLOY = Path(__file__).parent.parent.parent / "deploy"
UNIT = DEPLOY / "ldo@.service"
PIN = re.compile(r"eclipse/zenoh:(\d+\.\d+)\.\d+")


def read_documents(name: str) -> list[Any]:
    return list(yaml.safe_load_all((DEPLOY / name).read_text()))


def path_of_tool(tool: str) -> str:
    """Return the path of a tool; skip the test if it is not installed."""
    path = shutil.which(tool)
    if path is None:
        pytest.skip(f"{tool} is not on the PATH")
    return path


@pytest.fixture
def port() -> int:
    return free_port()


# --- the router -----------------------------------------------------------------------------------
def test_example_router_file_equals_the_output_of_ldo_keys() -> None:
    """Update the file with `ldo keys router deploy/example > deploy/example/router.yaml`."""
    access = read_access(DEPLOY / "example" / "access.yaml")
    written = router_yaml(access, Path("/etc/ldo/keys"), 7447)
    assert (DEPLOY / "example" / "router.yaml").read_text() == written


def test_every_topic_has_a_role_that_publishes_and_roles_that_read_it() -> None:
    def keys(role: Any, message: str) -> set[str]:
        rules = [rule for rule in rules_of(role) if message in rule.messages]
        return {key for rule in rules for key in rule.keys}

    assert keys("service", "put") == keys("service", "declare_subscriber") == {"**"}
    readable = {topic.subscription_key for topic in TOPICS}
    for role in ("viewer", "operator"):
        assert keys(role, "declare_subscriber") == readable - {CONTROL.name}
    assert CONTROL.name in keys("operator", "query")
    assert CONTROL.name not in keys("viewer", "query")


def test_router_started_from_the_file_serves_the_listed_clients(tmp_path: Path) -> None:
    """Zenoh reads the file as `zenohd --config` does."""
    authority = CertificateAuthority.new(tmp_path / "keys", days=2)
    for name, role in (("router", "service"), ("wheels", "odometry"), ("desk", "viewer")):
        authority.add(name, role, "*", days=1)
    port = free_port()
    access = read_access(authority.folder / "access.yaml")
    file = tmp_path / "router.yaml"
    file.write_text(router_yaml(access, authority.folder / "router", port))
    endpoint = f"tls/127.0.0.1:{port}"
    with (
        zenoh.open(zenoh.Config.from_file(str(file))),
        connect("mule", endpoint, authority.folder / "desk") as desk,
        connect("mule", endpoint, authority.folder / "wheels") as wheels,
    ):
        for message in receive_priors(desk, wheels):
            assert message.T_prior_base == IDENTITY
            break


def receive_priors(desk: Any, wheels: Any) -> Iterator[Any]:
    """Publish odometry priors and yield those that the subscriber receives."""
    with desk.poller(ODOMETRY_PRIOR.name, ODOMETRY_PRIOR.message) as inbox:
        while True:
            wheels.publish_prior(IDENTITY, stamp_ns=1)
            yield from inbox()


# --- metrics --------------------------------------------------------------------------------------
def exported_labels() -> dict[str, set[str]]:
    """Return the labels of each exported Prometheus sample by its name."""
    collector = HealthCollector("mule")
    collector.on_health(b"", memoryview(encode(EXAMPLES["health"])))
    samples = [sample for family in collector.collect() for sample in family.samples]
    return {sample.name: set(sample.labels) for sample in samples}


def dashboard_expressions() -> list[str]:
    """Return the expressions of the Grafana dashboard."""
    dashboard = json.loads((DEPLOY / "grafana.json").read_text())
    return [target["expr"] for panel in dashboard["panels"] for target in panel["targets"]]


def test_dashboard_uses_every_metric_with_existing_labels() -> None:
    available, used = exported_labels(), set()
    for expression in dashboard_expressions():
        ((name, selector),) = re.findall(r"(ldo_\w+)\{([^}]*)\}", expression)
        used.add(name)
        labels = set(re.findall(r"(\w+)=", selector))
        assert labels <= available[name], expression
    assert used == set(available) - {
        "ldo_paused",
        "ldo_input_messages_total",
        "ldo_input_gaps_total",
    }


def test_prometheus_scrapes_the_metrics_port_of_the_unit() -> None:
    (config,) = read_documents("prometheus.yaml")
    (target,) = config["scrape_configs"][0]["static_configs"][0]["targets"]
    unit = UNIT.read_text()
    assert "--metrics-port ${LDO_METRICS_PORT}" in unit
    assert f"LDO_METRICS_PORT={target.rpartition(':')[2]}\n" in unit


def test_local_socket_of_the_unit_is_in_a_private_folder() -> None:
    unit = UNIT.read_text()
    assert "--local-socket /run/ldo/%i/link" in unit
    assert "RuntimeDirectory=ldo/%i\nRuntimeDirectoryMode=0700" in unit


def test_each_robot_of_a_machine_can_have_ports_of_its_own() -> None:
    lines = UNIT.read_text().splitlines()
    (start,) = [line for line in lines if line.startswith("ExecStart=")]
    assert "--endpoint ${LDO_ENDPOINT} " in start
    assert "--metrics-port ${LDO_METRICS_PORT}" in start
    assert re.findall(r":\d+|port \d+", start) == [], "the command fixes no port"
    assert "EnvironmentFile=-/etc/ldo/%i.env" in lines, "a file of the robot replaces the ports"


def test_unit_reads_keys_that_root_replaces_and_no_other_user_reads() -> None:
    """Run the commands of deploy.md with a group that exists, and read the files as two users."""
    lines = UNIT.read_text().splitlines()
    (start,) = [line for line in lines if line.startswith("ExecStart=")]
    (group,) = [line.partition("=")[2] for line in lines if line.startswith("SupplementaryGroups=")]
    folder = start.split("--keys ")[1].split()[0]
    assert not [line for line in lines if line.startswith("LoadCredential")], "copied at the start"
    page = (DEPLOY.parent / "docs" / "deploy.md").read_text()
    assert f"groupadd --system {group}\n" in page
    found = re.findall(rf"^install .*-g {group} .*{folder}.*?(?=\s+#)", page, re.MULTILINE)
    assert len(found) == 3, "the folder, the first keys, and renewed keys"
    gid = 54_321 if os.geteuid() == 0 else os.getegid()
    with TemporaryDirectory() as parent:
        os.chmod(parent, 0o755)
        authority = CertificateAuthority.new(Path(parent) / "authority", days=2)
        for name in ("mule", "mule-2"):
            authority.add(name, "service", "mule", days=1)
        keys = Path(parent) / "keys"
        before = b""
        for command in found:
            command = command.replace(group, str(gid)).replace(folder, str(keys))
            subprocess.run(command, shell=True, check=True, cwd=authority.folder)
            files = [keys / "ca.crt", keys / "tls.crt", keys / "tls.key", keys / "access.yaml"]
            if not files[0].exists():
                continue
            assert before != files[2].read_bytes(), "the second command replaces the key"
            before = files[2].read_bytes()
            TlsKeys(keys)
            assert {file.stat().st_mode & 0o777 for file in files} == {0o640}
            assert (keys.stat().st_mode & 0o777, keys.stat().st_gid) == (0o750, gid)
            if os.geteuid() == 0:
                read = ["cat", *map(str, files)]
                user: dict[str, Any] = {"user": 54_322, "group": 54_322, "capture_output": True}
                subprocess.run(read, check=True, extra_groups=[gid], **user)
                assert subprocess.run(read, extra_groups=[], **user).returncode != 0


# --- commands -------------------------------------------------------------------------------------
def commands() -> Iterator[list[str]]:
    """Yield every command line of `ldo` in deploy/."""
    (compose,) = read_documents("compose.yaml")
    for service in compose["services"].values():
        if service["image"] == "ldo-slam" and "entrypoint" not in service:
            yield service["command"]
    for document in read_documents("kubernetes.yaml"):
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
def test_commands_use_existing_verbs_and_options(
    command: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    verb, *arguments = command
    with pytest.raises(SystemExit):
        cli.main([verb, "--help"])
    available = set(re.findall(r"--[\w-]+", capsys.readouterr().out))
    assert {word.partition("=")[0] for word in arguments if word.startswith("--")} <= available


def test_compose_health_check_fails_and_says_why_while_an_actor_is_silent_or_fails(
    port: int,
) -> None:
    """The check is the one in compose.yaml, run against a collector of one actor."""
    (compose,) = read_documents("compose.yaml")
    service = compose["services"]["service"]
    (metrics,) = [
        w.partition("=")[2] for w in service["command"] if w.startswith("--metrics-port=")
    ]
    *_, program = service["healthcheck"]["test"]
    assert f":{metrics}/" in program
    program = program.replace(f":{metrics}/", f":{port}/")
    collector = HealthCollector("mule", ["mapper"])
    with serve_metrics(collector, port):
        done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
        assert (done.returncode, done.stderr) == (1, "no heartbeat: mapper\n\n")
        failing = msgspec.structs.replace(EXAMPLES["health"], failing=True)
        collector.on_health(b"", memoryview(encode(failing)))
        done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
        assert (done.returncode, done.stderr) == (1, "failing on every message: mapper\n\n")
        collector.on_health(b"", memoryview(encode(EXAMPLES["health"])))
        subprocess.run([sys.executable, "-c", program], check=True)


def test_each_pod_of_the_fleet_mounts_the_keys_of_its_robot(tmp_path: Path) -> None:
    authority = CertificateAuthority.new(tmp_path / "keys", days=2)
    authority.add("robot-0", "service", "robot-0", days=1)
    key_files = {path.name for path in (authority.folder / "robot-0").iterdir()}
    (fleet,) = [d for d in read_documents("kubernetes.yaml") if d["kind"] == "StatefulSet"]
    spec = fleet["spec"]["template"]["spec"]
    (keys,) = [volume for volume in spec["volumes"] if volume["name"] == "keys"]
    sources = [source["secret"] for source in keys["projected"]["sources"]]
    assert len(sources) == fleet["spec"]["replicas"]
    for number, secret in enumerate(sources):
        robot = f"{fleet['metadata']['name']}-{number}"
        assert secret["name"] == f"ldo-{robot}"
        paths = {item["key"]: item["path"] for item in secret["items"]}
        assert paths == {name: f"{robot}/{name}" for name in key_files}
    ((mount,),) = [
        [mount for mount in container["volumeMounts"] if mount["name"] == "keys"]
        for container in spec["containers"]
    ]
    assert mount["subPathExpr"] == "$(ROBOT)"


def test_router_image_has_the_version_of_the_installed_zenoh_client() -> None:
    installed = ".".join(version("eclipse-zenoh").split(".")[:2])
    text = "".join(path.read_text() for path in DEPLOY.glob("*.yaml"))
    assert set(PIN.findall(text)) == {installed}


def test_every_dependency_has_a_lower_and_an_upper_bound() -> None:
    project = tomllib.loads((DEPLOY.parent / "pyproject.toml").read_text())["project"]
    extras = [
        dependency for extra in project["optional-dependencies"].values() for dependency in extra
    ]
    for dependency in (*project["dependencies"], *extras):
        assert re.fullmatch(r"[\w-]+>=[\d.]+,<[\d.]+", dependency)


# --- tools ----------------------------------------------------------------------------------------
def test_systemd_accepts_the_unit(tmp_path: Path) -> None:
    tool = path_of_tool("systemd-analyze")
    unit = UNIT.read_text().replace("/opt/ldo/bin/ldo", sys.executable)
    (tmp_path / "ldo@.service").write_text(unit)
    command = [tool, "verify", "--man=no", str(tmp_path / "ldo@mule.service")]
    (tmp_path / "ldo@mule.service").symlink_to("ldo@.service")
    done = subprocess.run(command, capture_output=True, text=True)
    unit_messages = [line for line in done.stderr.splitlines() if "ldo@" in line]
    assert (done.returncode, unit_messages) == (0, [])


def compose_commands() -> Iterator[list[str]]:
    """Yield the installed commands of Compose 2, which reads files without a version."""
    for command in (["docker", "compose"], ["docker-compose"]):
        if shutil.which(command[0]):
            done = subprocess.run([*command, "version"], capture_output=True, text=True)
            if done.returncode == 0 and " 1." not in done.stdout.splitlines()[0]:
                yield command


def test_compose_accepts_the_file() -> None:
    command = next(compose_commands(), None)
    if command is None:
        pytest.skip("neither docker-compose nor docker with its plug-in `compose` is installed")
    file = ["--file", str(DEPLOY / "compose.yaml")]
    done = subprocess.run([*command, *file, "config", "--quiet"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_kustomize_accepts_the_fleet(tmp_path: Path) -> None:
    tool = path_of_tool("kubectl")
    shutil.copyfile(DEPLOY / "kubernetes.yaml", tmp_path / "fleet.yaml")
    (tmp_path / "kustomization.yaml").write_text("resources: [fleet.yaml]\n")
    done = subprocess.run([tool, "kustomize", str(tmp_path)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert len(list(yaml.safe_load_all(done.stdout))) == len(read_documents("kubernetes.yaml"))


def test_fleet_is_valid_against_the_kubernetes_schemas() -> None:
    schemas = pytest.importorskip("kubernetes_validate", reason="pip install --group kubernetes")
    for document in read_documents("kubernetes.yaml"):
        schemas.validate(document, schemas.latest_version(), strict=True)


def test_fleet_mounts_and_selectors_match_their_definitions() -> None:
    for document in read_documents("kubernetes.yaml"):
        for container in containers(document):
            spec = document["spec"]
            volumes = {volume["name"] for volume in spec["template"]["spec"]["volumes"]}
            volumes |= {claim["metadata"]["name"] for claim in spec.get("volumeClaimTemplates", ())}
            assert {mount["name"] for mount in container["volumeMounts"]} == volumes
            assert document["spec"]["selector"]["matchLabels"].items() <= (
                spec["template"]["metadata"]["labels"].items()
            )


def test_dockerfile_uses_existing_stages_and_files() -> None:
    lines = (DEPLOY / "Dockerfile").read_text().splitlines()
    stages = [line.split()[-1] for line in lines if line.startswith("FROM")]
    sources = [line.split()[1] for line in lines if line.startswith("FROM")]
    assert stages == ["build", "base", "cpu"], "the default build is the last stage"
    assert set(sources[2:]) <= set(stages)
    ignore_lines = (DEPLOY / "Dockerfile.dockerignore").read_text().splitlines()
    for name in (line[1:] for line in ignore_lines if line.startswith("!")):
        assert (DEPLOY.parent / name).exists()


def test_image_for_a_gpu_extends_the_image_for_the_cpu() -> None:
    text, base = (DEPLOY / "Dockerfile.cuda").read_text(), (DEPLOY / "Dockerfile").read_text()
    image = read_documents("compose.yaml")[0]["x-ldo"]["image"]
    assert f"ARG BASE={image}\nFROM ${{BASE}}" in text
    assert "COPY" not in text, "the build context is empty"
    assert set(re.findall(r"^USER (\w+)$", text, re.M)) == {"root", "ldo"}
    assert text.index("USER root") < text.index("RUN") < text.index("USER ldo")
    assert "useradd --uid 10001 --create-home ldo" in base
    (extra,) = re.findall(r'"ldo-slam\[(\w+)\]"', text)
    assert extra in project()["optional-dependencies"]
    command = json.loads(text[text.index("CMD ") + 4 :])
    assert command[:3] == json.loads(base[base.index("CMD ") + 4 :].splitlines()[0])
    assert command[3:] == ["--device", "auto"]


def test_service_on_a_gpu_differs_from_that_on_the_cpu_by_its_device() -> None:
    (base,), (gpu,) = read_documents("compose.yaml"), read_documents("compose.cuda.yaml")
    (name,) = gpu["services"]
    service, ours = base["services"][name], gpu["services"][name]
    assert ours["command"] == [*service["command"], "--device=auto"]
    assert (DEPLOY / ours["build"]["context"] / ours["build"]["dockerfile"]).is_file()
    volume, folder = ours["volumes"][0].split(":")
    assert volume in gpu["volumes"]
    image = (DEPLOY / "Dockerfile.cuda").read_text()
    assert f"TRITON_CACHE_DIR={folder} LDO_CACHE={folder}/" in image


def test_only_the_extra_for_a_gpu_needs_torch() -> None:
    found = project()
    assert found["optional-dependencies"]["cuda"] == ["torch>=2.13,<2.14"]
    others = [extra for name, extra in found["optional-dependencies"].items() if name != "cuda"]
    for requirement in (*found["dependencies"], *(r for extra in others for r in extra)):
        assert not requirement.startswith(("torch", "triton", "nvidia"))


def project() -> dict:
    return tomllib.loads((DEPLOY.parent / "pyproject.toml").read_text())["project"]
