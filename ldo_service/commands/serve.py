"""ldo serve"""

from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import tyro

from ldo_service.config import load_config
from ldo_service.runtime.zenoh_transport import DEFAULT_ENDPOINT, Network
from ldo_service.service import Service, state_folder

from .options import ConfigFile, Endpoint, Robot, Settings


def serve(
    robot: Robot = "robot",
    endpoint: Endpoint = DEFAULT_ENDPOINT,
    only: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]],
        tyro.conf.arg(
            metavar="ACTOR",
            help="run this actor alone, as a part of a service that runs already; may be repeated",
        ),
    ] = (),
    config: ConfigFile = None,
    set: Settings = (),
    state: Annotated[
        Path | None,
        tyro.conf.arg(
            metavar="DIR",
            help="where actors keep what a successor needs; default: a temporary folder",
        ),
    ] = None,
    metrics: Annotated[
        int | None,
        tyro.conf.arg(
            metavar="PORT", help="export every actor's health for Prometheus on 127.0.0.1:PORT"
        ),
    ] = None,
) -> None:
    """Run the service: camera frames in on camera/rgbd; poses, map and health out.

    Stop it with Ctrl-C: each stage finishes what it has. A second Ctrl-C stops at once.

      ldo serve
      ldo publish synthetic:room --rate 15      (in another terminal)
    """
    with ExitStack() as stack:
        folder = state_folder(state, stack)
        Service(
            load_config(config, set),
            Network(robot, endpoint),
            folder,
            tuple(only),
            is_state_kept=state is not None,
            metrics_port=metrics,
        ).run()
