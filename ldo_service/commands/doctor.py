"""ldo doctor"""

import importlib.util
import os
import platform
import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version

from rich.console import Console

from ldo_service import __version__, kernels
from ldo_service.client import connect
from ldo_service.errors import ConfigError, LdoError
from ldo_service.runtime.zenoh_transport import DEFAULT_ENDPOINT
from ldo_service.schemas import Health
from ldo_service.schemas.topics import HEALTH

from .options import Endpoint, Robot

LIBRARIES = {  # name on the package index: name to import
    "numpy": "numpy",
    "msgspec": "msgspec",
    "eclipse-zenoh": "zenoh",
    "gtsam": "gtsam",
    "small-gicp": "small_gicp",
    "opencv-python-headless": "cv2",
    "onnxruntime": "onnxruntime",
    "scipy": "scipy",
    "mcap": "mcap",
    "safetensors": "safetensors",
    "zstandard": "zstandard",
}
EXTRAS = {"viewer": ("viser", "gsply"), "cuda": ("torch", "gsplat")}
LISTEN_S = 1.5  # three heartbeats
MARKS = {"ok": "[green]ok[/]     ", "absent": "[dim]absent[/] ", "bad": "[red]bad[/]    "}


@dataclass(frozen=True, slots=True)
class Finding:
    mark: str  # "ok", "absent": fine without; "bad": something to mend
    text: str


def doctor(robot: Robot = "robot", endpoint: Endpoint = DEFAULT_ENDPOINT) -> None:
    """Say what this machine has, what is missing and how to get it, and how a running service is.

    Exit code 1 when something is bad.
    """
    console = Console(highlight=False, soft_wrap=True)
    bad = 0
    for finding in (*machine(), *libraries(), *extras(), *service(robot, endpoint)):
        console.print(MARKS[finding.mark] + finding.text)
        bad += finding.mark == "bad"
    if bad:
        raise LdoError(f"{bad} of the above must be mended.")


def machine() -> Iterator[Finding]:
    yield Finding("ok", f"ldo-slam {__version__}, Python {platform.python_version()}")
    memory_gb = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    yield Finding(
        "ok",
        f"{platform.machine()}, {os.cpu_count()} cores, {memory_gb:.0f} GB, kernels: "
        f"{kernels.isa()} (LDO_ISA forces another)",
    )
    free_gb = shutil.disk_usage(os.getcwd()).free / 1e9
    mark = "ok" if free_gb > 1 else "bad"
    yield Finding(mark, f"{free_gb:.1f} GB free in this folder; a run takes about 0.1 GB")


def libraries() -> Iterator[Finding]:
    for package, module in LIBRARIES.items():
        try:
            importlib.import_module(module)
            yield Finding("ok", f"{package} {version(package)}")
        except (ImportError, PackageNotFoundError) as error:
            yield Finding("bad", f"{package}: {error}. Get it with `pip install {package}`.")


def extras() -> Iterator[Finding]:
    for extra, packages in EXTRAS.items():
        missing = [p for p in packages if importlib.util.find_spec(p) is None]
        if missing:
            advice = f"`pip install 'ldo-slam\\[{extra}]'` brings it"  # escaped for rich
            yield Finding("absent", f"extra {extra} ({', '.join(missing)}): {advice}")
        else:
            yield Finding("ok", f"extra {extra}")


def service(robot: str, endpoint: str) -> Iterator[Finding]:
    try:
        actors = heard(robot, endpoint)
    except ConfigError:
        yield Finding("absent", f"no service on {endpoint}: `ldo serve` starts one")
        return
    if not actors:
        yield Finding(
            "bad",
            f"something answers on {endpoint}, and no actor of robot {robot!r} is heard: is that "
            "its name, and does the router's access control let this client subscribe?",
        )
    for health in actors.values():
        yield from _of_actor(health)


def heard(robot: str, endpoint: str) -> dict[str, Health]:
    """The last heartbeat of each actor. Raises ConfigError when nobody answers."""
    actors: dict[str, Health] = {}
    with connect(robot, endpoint) as client, client.listen(f"{HEALTH.name}/*", Health) as inbox:
        until_s = time.monotonic() + LISTEN_S
        while time.monotonic() < until_s:
            for health in inbox():
                actors[health.actor] = health
            time.sleep(0.05)
    return actors


def _of_actor(health: Health) -> Iterator[Finding]:
    dropped = sum(i.dropped for i in health.inputs)
    rejected = sum(i.rejected for i in health.inputs)
    troubled = health.set_aside > 0 or health.restarts > 0
    yield Finding(
        "bad" if troubled else "ok",
        f"{health.actor} (process {health.pid}): {health.state}, {health.steps} steps of "
        f"{health.step_ms_p50:.1f} ms p50, {health.step_ms_p95:.1f} ms p95, {dropped} dropped, "
        f"{rejected} rejected, {health.restarts} restarts, {health.rss_mb:.0f} MB",
    )
