"""Command `ldo doctor`: check this machine and a running service, or the camera of a run."""

import importlib.util
import os
import platform
import shutil
import time
from collections.abc import Iterator
from datetime import date
from importlib.metadata import PackageNotFoundError, version
from math import inf
from pathlib import Path
from typing import Annotated, Literal

import tyro

from ldo_service import __version__, kernels
from ldo_service.actors.topology import GRAPH
from ldo_service.client import connect
from ldo_service.detection.model_registry import Models
from ldo_service.detection.onnx_network import CUDA, providers_of
from ldo_service.errors import (
    ConfigError,
    DeviceError,
    ModelError,
    UnavailableError,
    install_command,
)
from ldo_service.gaussians import GaussianOptimizerConfig
from ldo_service.gaussians.device_choice import choose_backend
from ldo_service.kernels.gpu.benchmark_result import COMMAND
from ldo_service.kernels.gpu.device import find_gpu
from ldo_service.schemas import Health
from ldo_service.schemas.topics import HEALTH
from ldo_service.service.diagnostics import ActorStatus, diagnose, notes
from ldo_service.service.forecast import forecast
from ldo_service.service.state_forecast import forecast_of_state
from ldo_service.tracking.aligner import choose_aligner
from ldo_service.transport.endpoint import DEFAULT_ENDPOINT, Endpoint
from ldo_service.transport.keys import TlsKeys, expiry_warning

from .calibration_report import camera_findings
from .findings import Finding, show
from .options import EndpointAddress, KeysFolder, Robot, argument

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
    "bags": ("rosbags",),
    "phones": ("av", "liblzfse"),
    "s3": ("s3fs",),
    "cluster": ("ray", "s3fs"),
    "cuda": ("torch", "triton"),
}
# Extras that are experimental.
EXPERIMENTAL = {
    "cuda": "Computing on a GPU is experimental until `ldo bench --device cuda` has passed on it"
}
REINSTALL = "`.venv/bin/pip install -e .` in the clone of LDO-SLAM installs all libraries."
# Time for which a running service is observed, seconds: six heartbeats, and six keyframes at 2 Hz.
WINDOW_S = 3.0
Check = Annotated[
    Literal["service", "calibration", "forecast"],
    tyro.conf.Positional,
    argument(
        metavar="[CHECK]",
        help="service: this machine and the running service; calibration: the camera of the "
        "finished run DIR; forecast: the growth of the state folder DIR",
    ),
]
Folder = Annotated[
    Path | None,
    tyro.conf.Positional,
    argument(
        metavar="[DIR]",
        help="folder of a run for calibration, or of a service's state for forecast",
    ),
]


def doctor(
    check: Check = "service",
    folder: Folder = None,
    robot: Robot = "robot",
    endpoint: EndpointAddress = DEFAULT_ENDPOINT,
    keys: KeysFolder = None,
    window_s: Annotated[
        float,
        argument(
            metavar="SECONDS",
            help="time for which a running service is observed; the forecast gets better with it",
        ),
    ] = WINDOW_S,
) -> None:
    """Check this machine and a running service, or a camera, and print how to fix each problem.

    The exit code is 1 if a line is marked bad.

    `ldo doctor calibration DIR` prints what the run in DIR has found about its camera: depth bias,
    vignetting, and the times at which rows of color and depth are recorded. A line marked warn
    says how a large value affects the results and how to avoid this effect.

    For a running service, the last lines are a forecast. They state how much memory, disk space and
    time a keyframe takes, and which limits the service reaches within 24 hours at this rate.
    `ldo doctor forecast DIR` prints a forecast for the state folder DIR.

      ldo doctor
      ldo doctor --window-s 300
      ldo doctor forecast states/robot
      ldo doctor calibration runs/desk
    """
    if not 0 < window_s < inf:
        raise ConfigError(f"--window-s {window_s:g} must be positive and finite.")
    if check == "service":
        if folder is not None:
            raise ConfigError(
                f"`ldo doctor service` checks no folder, but {folder} is given. Remove it, or use "
                f"`ldo doctor calibration {folder}` or `ldo doctor forecast {folder}`."
            )
        show(
            (
                *(*machine(), *libraries(), *extras(), *devices(), *networks()),
                *(*certificates(endpoint, keys), *service(robot, endpoint, keys, window_s)),
            )
        )
    elif folder is None:
        example = {"calibration": "runs/desk", "forecast": "states/robot"}[check]
        raise ConfigError(
            f"`ldo doctor {check}` needs a folder, as in `ldo doctor {check} {example}`."
        )
    elif check == "calibration":
        show(camera_findings(folder))
    else:
        show(Finding("note", line) for line in forecast_of_state(folder).lines())


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
        note = f". {EXPERIMENTAL[extra]}" if extra in EXPERIMENTAL else ""
        if missing:
            advice = f"to use it, run {install_command(extra)}{note}"
            yield Finding("absent", f"extra {extra} (missing: {', '.join(missing)}): {advice}")
        else:
            yield Finding("ok", f"extra {extra}{note}")


def devices() -> Iterator[Finding]:
    """Report the devices that `service.device=auto` chooses on this machine, and why."""
    defaults = GaussianOptimizerConfig()
    _, choice = choose_backend("auto", defaults.adam, defaults.loss, defaults.limits)
    mark = "ok" if choice.device == "cuda" else "note"
    yield Finding(
        "warn" if choice.has_failed else mark,
        f"service.device=auto chooses {choice.device} ({choice.name}) for the mapper: "
        f"{choice.reason}",
    )
    aligned = choose_aligner("auto").device
    mark = "ok" if aligned.device == "cuda" else "note"
    yield Finding(
        "warn" if aligned.has_failed else mark,
        f"service.device=auto chooses {aligned.device} ({aligned.name}) for the tracker: "
        f"{aligned.reason}",
    )
    on_gpu = providers_of("auto")[0] == CUDA
    device, has = ("cuda", "has") if on_gpu else ("cpu", "lacks")
    yield Finding(
        "ok" if on_gpu else "note",
        f"service.device=auto chooses {device} for the networks: the installed onnxruntime {has} "
        f"{CUDA}",
    )
    yield from gpus()


def gpus() -> Iterator[Finding]:
    """Report whether the GPU has passed the benchmark; without a GPU, report nothing."""
    try:
        gpu = find_gpu()
    except DeviceError:
        return
    result = gpu.benchmark()
    if result is None:
        yield Finding(
            "note",
            f"the GPU {gpu.name} is experimental until {COMMAND} has passed on it with the "
            "installed versions",
        )
    elif result.has_passed:
        yield Finding("ok", f"the GPU {gpu.name} has passed {COMMAND} ({result.scene})")
    else:
        yield Finding(
            "warn",
            f"the GPU {gpu.name} has failed {COMMAND}: {result.error} Until it passes, auto uses "
            "the CPU. Run it again while no service uses the GPU.",
        )


def networks() -> Iterator[Finding]:
    """Check the registered networks."""
    models = Models()
    if not models.names:
        yield Finding(
            "absent",
            "no network is registered. The built-in `demo` recognizes only objects of the "
            "synthetic scenes. `ldo models add NAME FILE` registers a YOLOv5, YOLOX or YOLOv8 in "
            "ONNX",
        )
    for name in models.names:
        try:
            model = models.get(name)
            model.verify()
            yield Finding("ok", f"network {name}: {model.summary}")
        except ModelError as error:
            yield Finding("bad", f"network {name}: {error}")


def service(
    robot: str, endpoint: str, keys: Path | None, window_s: float = WINDOW_S
) -> Iterator[Finding]:
    """Check every actor of the running service, if there is one, and print a forecast."""
    try:
        actors, heard = seen(robot, endpoint, keys, window_s)
    except ConfigError as error:
        if keys is None and isinstance(error, UnavailableError):
            yield Finding("absent", f"no service on {endpoint}: `ldo serve` starts one")
        else:
            yield Finding("bad", str(error))
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
    yield from (Finding("note", line) for line in forecast(heard).lines())


def certificates(endpoint: str, keys: Path | None) -> Iterator[Finding]:
    """Check how long the keys and the certificate of the service are valid."""
    own = TlsKeys.of(keys)
    if own is None:
        return
    host, port = Endpoint(endpoint=endpoint, keys=own).address
    found = {f"the keys in {own.folder}": own.valid_until_s()}
    if port.isdecimal():
        found[f"the certificate of the service on {endpoint}"] = own.server_valid_until_s(
            host, int(port)
        )
    for what, until_s in found.items():
        if when := expiry_warning(until_s):
            yield Finding("warn", f"{what} {when}: make new ones by `ldo keys`")
        elif until_s is not None:
            yield Finding("ok", f"{what}: valid until {date.fromtimestamp(until_s)}")


def seen(
    robot: str, endpoint: str, keys: Path | None = None, window_s: float = WINDOW_S
) -> tuple[list[ActorStatus], dict[str, list[tuple[float, Health]]]]:
    """Receive the heartbeats of the actors of a service for some time.

    Args:
        robot: Name of the robot.
        endpoint: Address of the service's router.
        keys: Folder with TLS keys; None for a service without keys.
        window_s: Duration, seconds.

    Returns:
        The status of every actor, and the list of heartbeats of each actor by its name. Each
        heartbeat has its arrival time on the monotonic clock, seconds.

    Raises:
        ConfigError: No router answers on the endpoint.
    """
    heard: dict[str, list[tuple[float, Health]]] = {}
    with (
        connect(robot, endpoint, keys) as client,
        client.poller(HEALTH.subscription_key, Health) as inbox,
    ):
        until_s = time.monotonic() + window_s
        while time.monotonic() < until_s:
            for health in inbox():
                heard.setdefault(health.actor, []).append((time.monotonic(), health))
            time.sleep(0.05)
        alive, now_s = client.live_actors(), time.monotonic()
    names = [spec.name for spec in GRAPH]
    names += sorted((set(heard) | alive) - set(names))  # Actors of a later version.
    actors = [
        ActorStatus(name, name in alive, None, window_s)
        if name not in heard
        else ActorStatus(name, name in alive, heard[name][-1][1], window_s,
                         heartbeat_age_s=now_s - heard[name][-1][0])
        for name in names
    ]  # fmt: skip
    return actors, heard


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
