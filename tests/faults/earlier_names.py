"""Names of commit 18f9264, and the command line of programs that run at that commit and now."""

import logging
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

Program = Callable[[], bool]
MAX_S = 1200  # Time limit of a program, at which it ends itself without a verdict.

# Present place or name, and that of commit 18f9264.
NAMES = {
    "AddLabel": ("ldo_service.schemas:AddLabel", "ldo_service.schemas:LabelAdd"),
    "RefineMap": ("ldo_service.schemas:RefineMap", "ldo_service.schemas:MapRefine"),
    "FolderStore": (
        "ldo_service.storage.state_store:FolderStore",
        "ldo_service.runtime.state_store:FolderStore",
    ),
    "HealthCollector": (
        "ldo_service.service.metrics:HealthCollector",
        "ldo_service.metrics:HealthCollector",
    ),
    "serve_metrics": (
        "ldo_service.service.metrics_server:serve_metrics",
        "ldo_service.metrics:exported",
    ),
    "HttpClient": (
        "ldo_service.detection.labellers.http_endpoint:HttpClient",
        "ldo_service.semantics.labellers.endpoint:Endpoint",
    ),
    "HttpClientConfig": (
        "ldo_service.detection.labellers.http_endpoint:HttpClientConfig",
        "ldo_service.semantics.labellers.endpoint:EndpointConfig",
    ),
    "MemoryTransport": (
        "ldo_service.transport.interface:MemoryTransport",
        "ldo_service.runtime.transport:MemoryTransport",
    ),
    "SupervisionConfig": (
        "ldo_service.runtime.supervision_policy:SupervisionConfig",
        "ldo_service.runtime.stage_config:StageConfig",
    ),
    "initial_rate": ("initial_rate", "first_rate"),
    "final_rate": ("final_rate", "last_rate"),
    "dead_lettered": ("dead_lettered", "set_aside"),
    "evicted_consumers": ("evicted_consumers", "evicted"),
    "on_saved": ("on_saved", "saved"),
    "T_prior_base": ("T_prior_base", "T_odom_base"),
    "AuthorityOfKeys": (
        "ldo_service.transport.certificate_authority:CertificateAuthority",
        "ldo_service.authority:Authority",
    ),
    "Endpoint": (
        "ldo_service.transport.zenoh_transport:Endpoint",
        "ldo_service.runtime.zenoh_transport:Network",
    ),
    "TlsKeys": ("ldo_service.transport.keys:TlsKeys", "ldo_service.runtime.keys:Keys"),
    "ZenohTransport": (
        "ldo_service.transport.zenoh_transport:ZenohTransport",
        "ldo_service.runtime.zenoh_transport:ZenohTransport",
    ),
    "open_session": (
        "ldo_service.transport.zenoh_transport:open_session",
        "ldo_service.runtime.zenoh_transport:open_session",
    ),
    "cli": ("ldo_service.commands.cli:", "ldo_service.cli:"),
    "service": ("ldo_service.service.service:", "ldo_service.service:"),
    "StopRequest": (
        "ldo_service.runtime.supervision:StopRequest",
        "ldo_service.runtime.supervision:Stop",
    ),
    "exit_with_parent": (
        "ldo_service.runtime.process:exit_with_parent",
        "ldo_service.runtime.process:leave_with_parent",
    ),
    "OffloadedGaussians": (
        "ldo_service.gaussians.offloading:OffloadedGaussians",
        "ldo_service.gaussians.sleep:SleepingGaussians",
    ),
    "request": ("request", "ask"),
    "command": ("command", "verb"),
    "message": ("message", "text"),
    "metrics": ("metrics", "facts"),
    "paused": ("paused", "held"),
    "--actor": ("--actor", "--only"),
    "--client": ("--client", "--join"),
    "--metrics-port": ("--metrics-port", "--metrics"),
    "service.process_actors": ("service.process_actors", "service.spawned"),
    "service.shutdown_timeout_s": ("service.shutdown_timeout_s", "service.drain_s"),
    "supervision.step_timeout_s": ("supervision.step_timeout_s", "stage.stall_after_s"),
    "service.heartbeat_timeout_s": ("service.heartbeat_timeout_s", "service.silent_after_s"),
    "service.fsync": ("service.fsync", "service.sync_state"),
    "mapper.offload.max_resident_gaussians": (
        "mapper.offload.max_resident_gaussians",
        "mapper.builder.sleep.max_active",
    ),
    "mapper.checkpoint_interval_keyframes": (
        "mapper.checkpoint_interval_keyframes",
        "mapper.checkpoint_keyframes",
    ),
}


def is_present() -> bool:
    """Return whether the installed package has the present names."""
    with suppress(ImportError):
        import_module("ldo_service.transport.interface")
        return True
    return False


IS_OLD = not is_present()


def name(present: str) -> str:
    """Return the name of a field, method or type in the installed package."""
    return NAMES[present][IS_OLD].rpartition(":")[2]


def found(present: str) -> Any:
    """Return a class or function of the installed package by its present name."""
    module, _, attribute = NAMES[present][IS_OLD].partition(":")
    return getattr(import_module(module), attribute)


def module(present: str) -> Any:
    """Return a module of the installed package by its present name."""
    return import_module(NAMES[present][IS_OLD].removesuffix(":"))


def run(programs: Mapping[str, Program], path: str) -> None:
    """Run the programs named on the command line, each in a process of its own; default: all.

    A program prints its figures, and its last line is the verdict.

    Args:
        programs: The programs by name.
        path: Path of the file that calls this function.
    """
    logging.disable(logging.CRITICAL)
    if len(sys.argv) == 2:
        signal.signal(signal.SIGALRM, _give_up)
        signal.alarm(MAX_S)
        seen = programs[sys.argv[1]]()
        print("SEEN" if seen else "NOT SEEN", flush=True)
        os._exit(seen)  # A step of an actor may still hang.
    verdicts = set()
    for program in sys.argv[1:] or programs:
        verdict, figures = outcome(program, path)
        verdicts.add(verdict)
        print(f"{verdict:<9} {program:<30} {figures}", flush=True)
    raise SystemExit(verdicts != {"NOT SEEN"})


def _give_up(*_: object) -> None:
    raise SystemExit(f"the program took more than {MAX_S} s")


def outcome(program: str, path: str) -> tuple[str, str]:
    """Run a program in a process of its own.

    Returns:
        The verdict SEEN, NOT SEEN or ERROR, and the figures or the end of the error.
    """
    command = [sys.executable, str(Path(path).resolve()), program]
    result = subprocess.run(command, capture_output=True, text=True)
    *figures, verdict = result.stdout.strip().splitlines() or [""]
    if verdict in ("SEEN", "NOT SEEN"):
        return verdict, "; ".join(figures)
    return "ERROR", f"{result.returncode}: {result.stdout[-300:]} {result.stderr[-600:]}"
