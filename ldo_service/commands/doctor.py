"""Command `ldo doctor`."""

import importlib.util
import os
import platform
import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from rich.console import Console
from rich.markup import escape

from ldo_service import __version__, kernels
from ldo_service.actors.topology import GRAPH
from ldo_service.client import connect
from ldo_service.detection.model_registry import Models
from ldo_service.errors import ConfigError, LdoError, ModelError, install_command
from ldo_service.schemas import Health
from ldo_service.schemas.topics import HEALTH
from ldo_service.service.diagnostics import ActorStatus, diagnose, notes
from ldo_service.transport.zenoh_transport import DEFAULT_ENDPOINT

from .options import EndpointAddress, KeysFolder, Robot

LIBRARIES = {  # Name on the package index: name to import.
    "numpy": "numpy",
    "msgspec": "msgspec",
    "eclipse-zenoh": "zenoh",
    "gtsam": "gtsam",
    "small-gicp": "small_gicp",
    "opencv-python-headless": "cv2",
    "onnxruntime": "onnxruntime",
    "scikit-image": "skimage",
    "scipy": "scipy",
    "mcap": "mcap",
    "safetensors": "safetensors",
    "tokenizers": "tokenizers",
    "zstandard": "zstandard",
}
EXTRAS = {  # Optional extra of the package: modules that it installs.
    "viewer": ("viser", "gsply"),
    "keys": ("cryptography",),
    "realsense": ("pyrealsense2",),
    "ros2": ("rosbags",),
}
REINSTALL = "`.venv/bin/pip install -e .` in the clone of LDO-SLAM installs all libraries."
LISTEN_S = 1.5  # Three heartbeats.
MARKS = {
    "ok": "[green]ok[/]     ",
    "absent": "[dim]absent[/] ",
    "bad": "[red]bad[/]    ",
    "note": "[dim]note[/]   ",
}


@dataclass(frozen=True, slots=True)
class Finding:
    """Result of one check, printed as one line."""

    # "ok", "absent" (an optional part is missing), "note" (information) or "bad" (needs action).
    mark: str
    text: str


def doctor(
    robot: Robot = "robot", endpoint: EndpointAddress = DEFAULT_ENDPOINT, keys: KeysFolder = None
) -> None:
    """Check this machine and a running service, and print how to fix each problem.

    The exit code is 1 if a line is marked bad.
    """
    console = Console(highlight=False, soft_wrap=True)
    bad = 0
    for finding in (
        *machine(),
        *libraries(),
        *extras(),
        *networks(),
        *service(robot, endpoint, keys),
    ):
        console.print(MARKS[finding.mark] + escape(finding.text))
        bad += finding.mark == "bad"
    if bad:
        raise LdoError(
            f"problems found: {bad}. Each line above that is marked bad says how to fix a problem."
        )


def machine() -> Iterator[Finding]:
    """Report version and processor, and check the free disk space."""
    yield Finding("ok", f"ldo-slam {__version__}, Python {platform.python_version()}")
    memory_gb = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    yield Finding(
        "ok",
        f"{platform.machine()}, {os.cpu_count()} cores, {memory_gb:.0f} GB, kernels: "
        f"{kernels.isa()} (LDO_ISA selects another)",
    )
    free_gb = shutil.disk_usage(os.getcwd()).free / 1e9
    mark = "ok" if free_gb > 1 else "bad"
    yield Finding(mark, f"{free_gb:.1f} GB free on the disk of this folder; keep more than 1 GB")


def libraries() -> Iterator[Finding]:
    """Check that every required library can be imported."""
    for package, module in LIBRARIES.items():
        try:
            importlib.import_module(module)
            yield Finding("ok", f"{package} {version(package)}")
        except (ImportError, PackageNotFoundError) as error:
            yield Finding("bad", f"{package}: {error}. {REINSTALL}")


def extras() -> Iterator[Finding]:
    """Check which optional extras are installed."""
    for extra, packages in EXTRAS.items():
        missing = [p for p in packages if importlib.util.find_spec(p) is None]
        if missing:
            advice = f"{install_command(extra)} installs it"
            yield Finding("absent", f"extra {extra} ({', '.join(missing)}): {advice}")
        else:
            yield Finding("ok", f"extra {extra}")


def networks() -> Iterator[Finding]:
    """Check the registered networks."""
    models = Models()
    if not models.names:
        yield Finding(
            "absent",
            "registered networks: the built-in `demo` recognizes only objects of the synthetic "
            "scenes; `ldo models add NAME FILE` registers a YOLOv5, YOLOX or YOLOv8 in ONNX",
        )
    for name in models.names:
        try:
            model = models.get(name)
            model.verify()
            layout, classes = model.about.layout, len(model.about.classes)
            yield Finding("ok", f"network {name}: {layout}, {classes} classes")
        except ModelError as error:
            yield Finding("bad", f"network {name}: {error}")


def service(robot: str, endpoint: str, keys: Path | None) -> Iterator[Finding]:
    """Check every actor of the running service, if there is one."""
    try:
        actors = seen(robot, endpoint, keys)
    except ConfigError as error:
        if keys is not None:
            yield Finding("bad", str(error))
        else:
            yield Finding("absent", f"no service on {endpoint}: `ldo serve` starts one")
        return
    if not any(actor.has_token or actor.health for actor in actors):
        yield Finding(
            "bad",
            f"a router answers on {endpoint}, but no actor of robot {robot!r} sends a heartbeat. "
            "Check --robot, and that the role of these keys may read (viewer or operator).",
        )
        return
    for actor in actors:
        yield from of_actor(actor)


def seen(robot: str, endpoint: str, keys: Path | None = None) -> list[ActorStatus]:
    """Listen to a service for LISTEN_S and return the status of every actor.

    Raises:
        ConfigError: If no router answers on the endpoint.
    """
    heard: dict[str, tuple[float, Health]] = {}
    with (
        connect(robot, endpoint, keys) as client,
        client.poller(HEALTH.subscription_key, Health) as inbox,
    ):
        until_s = time.monotonic() + LISTEN_S
        while time.monotonic() < until_s:
            for health in inbox():
                heard[health.actor] = (time.monotonic(), health)
            time.sleep(0.05)
        alive, now_s = client.live_actors(), time.monotonic()
    names = [box.name for box in GRAPH]
    names += sorted((set(heard) | alive) - set(names))  # Actors of a later version.
    return [_seen(name, name in alive, heard.get(name), now_s) for name in names]


def _seen(
    name: str, has_token: bool, last: tuple[float, Health] | None, now_s: float
) -> ActorStatus:
    if last is None:
        return ActorStatus(name, has_token, None, LISTEN_S)
    heard_at_s, health = last
    return ActorStatus(name, has_token, health, LISTEN_S, heartbeat_age_s=now_s - heard_at_s)


def of_actor(actor: ActorStatus) -> Iterator[Finding]:
    """Yield the state of an actor, then its problems, then notes that need no action."""
    wrong = list(diagnose(actor))
    if actor.health is not None:
        yield Finding("bad" if wrong else "ok", _in_numbers(actor.health))
    for trouble in wrong:
        yield Finding("bad", f"{actor.actor} {trouble}")
    for remark in notes(actor):
        yield Finding("note", f"{actor.actor} {remark}")


def _in_numbers(health: Health) -> str:
    dropped = [
        f"{i.dropped} older {i.topic} replaced by newer ones" for i in health.inputs if i.dropped
    ]
    lost = sum(i.lost for i in health.inputs)
    rejected = sum(i.rejected for i in health.inputs)
    state = "paused" if health.paused else health.state
    return (
        f"{health.actor} (process {health.pid}): {state}, {health.steps} steps of "
        f"{health.step_ms_p50:.1f} ms p50, {health.step_ms_p95:.1f} ms p95, "
        f"{', '.join(dropped) or '0 dropped'}, "
        f"{lost} lost on the way, {rejected} rejected, {health.restarts} restarts, "
        f"{health.rss_mb:.0f} MB"
    )
