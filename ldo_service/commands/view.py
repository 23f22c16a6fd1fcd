"""Command `ldo view`: show a map in a browser."""

import importlib.util
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated

import tyro

from ldo_service.client import connect
from ldo_service.config import load_config
from ldo_service.errors import ConfigError, install_command
from ldo_service.transport.zenoh_transport import DEFAULT_ENDPOINT
from ldo_service.viewer.live import live
from ldo_service.viewer.run_folder import RunFolder
from ldo_service.viewer.scene import Source
from ldo_service.viewer.view_config import ViewerConfig, viewer_config

from .options import (
    ConfigFile,
    EndpointAddress,
    KeysFolder,
    Robot,
    Settings,
    argument,
    note_console,
)
from .query import LIVE


def view(
    where: Annotated[
        str,
        tyro.conf.Positional,
        argument(metavar="DIR|live", help="folder of a run, or the running service"),
    ],
    robot: Robot = "robot",
    endpoint: EndpointAddress = DEFAULT_ENDPOINT,
    keys: KeysFolder = None,
    config: ConfigFile = None,
    set: Settings = (),
) -> None:
    """Show a map in a browser: Gaussians, paths, keyframes, objects, loop closures, search.

    For a run in progress, the window shows the files written so far, and adds others when they
    appear. By default only browsers on this machine can open the window; see docs/viewer.md.
    Ctrl-C ends the command.

      ldo view runs/desk
      ldo view live --robot mule --endpoint tls/mule.local:7447 --keys keys/desk
    """
    require_viser()
    chosen = viewer_config(load_config(config, set).viewer)
    with suppress(KeyboardInterrupt), source_of(where, robot, endpoint, keys, chosen) as source:
        title = robot if where == LIVE else Path(where).resolve().name
        serve_window(source, chosen, f"ldo view {title}")


def require_viser() -> None:
    """Check that viser is installed.

    Raises:
        ConfigError: viser is not installed.
    """
    if importlib.util.find_spec("viser") is None:
        raise ConfigError(f"`ldo view` needs viser. Install it by {install_command('viewer')}.")


@contextmanager
def source_of(
    where: str, robot: str, endpoint: str, keys: Path | None, config: ViewerConfig
) -> Iterator[Source]:
    """Open the scene of a run folder or of a running service.

    Args:
        where: Folder of a run, or "live" for the running service.
        robot: Name of the robot.
        endpoint: Address of the service's router.
        keys: Folder with TLS keys; None for a service without keys.
        config: Settings of the viewer.

    Raises:
        DataError: The folder was not written by a run.
        ConfigError: No service answers.
    """
    if where != LIVE:
        yield RunFolder(Path(where).expanduser(), config)
        return
    with connect(robot, endpoint, keys) as service, live(service, config) as source:
        yield source


def serve_window(source: Source, config: ViewerConfig, title: str) -> None:
    """Show the scene in the browser window until the program is interrupted."""
    from ldo_service.viewer.window import open_window  # Viser is an optional extra.

    with open_window(source, config, title) as window:
        note_console().print(f"{title} on {window.url}")
        while True:
            window.show(source.update(is_watched=window.is_watched))
            time.sleep(config.update_s)
