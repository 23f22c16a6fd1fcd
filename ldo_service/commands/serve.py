"""Commands `ldo serve` and `ldo record`: run the service, and record the inputs of its actors."""

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import tyro

from ldo_service.config import load_config
from ldo_service.errors import ConfigError
from ldo_service.service.service import Service
from ldo_service.service.state_folder import state_folder
from ldo_service.storage.temporary_folder import temporary_folder
from ldo_service.transport.access_control import LOCAL
from ldo_service.transport.endpoint import DEFAULT_ENDPOINT, Endpoint
from ldo_service.transport.keys import OF_SERVICE, OTHERS, TlsKeys

from .options import (
    ActorNames,
    ConfigFile,
    Device,
    EndpointAddress,
    KeysFolder,
    Localize,
    Preset,
    Robot,
    Settings,
    StateFolder,
    argument,
    localizing,
    with_device,
    with_preset,
)

MAX_SOCKET_PATH = 107  # Maximum length of the path of a Unix socket on Linux, bytes.

Insecure = Annotated[
    bool, argument(help="listen on the network without keys: anyone there can control the service")
]
LocalSocket = Annotated[
    Path | None,
    argument(
        metavar="PATH",
        help="with --keys, Unix socket for programs on this machine, in a folder that other users "
        "cannot access; they use --endpoint unixsock-stream/PATH without keys",
    ),
]
Client = Annotated[bool, argument(help="connect to the router at ADDRESS instead of opening one")]
MetricsPort = Annotated[
    int | None,
    argument(
        metavar="PORT",
        help="serve the metrics of every actor for Prometheus on PORT of service.metrics_address",
    ),
]


def serve(
    robot: Robot = "robot",
    endpoint: EndpointAddress = DEFAULT_ENDPOINT,
    actor: ActorNames = (),
    config: ConfigFile = None,
    set: Settings = (),
    state: StateFolder = None,
    localize: Localize = None,
    record: Annotated[
        Path | None,
        argument(metavar="DIR", help="record the inputs of every actor, as `ldo record` does"),
    ] = None,
    keys: KeysFolder = None,
    insecure: Insecure = False,
    local_socket: LocalSocket = None,
    client: Client = False,
    metrics_port: MetricsPort = None,
    preset: Preset = "",
    device: Device = None,
) -> None:
    """Run the service: receive frames on camera/rgbd; publish poses, map, objects and health.

    Ctrl-C stops the service after each actor has finished its pending work. A second Ctrl-C stops
    the service immediately.

      ldo serve
      ldo publish synthetic:room --rate 15      (in another terminal)
    """
    settings = localizing(load_config(config, with_preset(set, preset)), localize)
    settings = with_device(settings, device)
    is_local = endpoint.startswith(f"{LOCAL}/")  # A child process of a service with keys.
    folder_of_keys = None if is_local else TlsKeys.of(keys or settings.service.keys or None)
    network = Endpoint(robot, endpoint, folder_of_keys, settings.service.max_message_mb)
    is_router = not (actor or client)
    if is_router and not insecure:
        network.require_safe()
    if local_socket is not None:
        local_socket = _usable_socket(local_socket, is_router and network.keys is not None)
    with ExitStack() as stack:
        folder = state_folder(state, stack)
        if is_router and network.keys:
            network.keys.warn_of_expiry(OF_SERVICE)
            path = local_socket or stack.enter_context(temporary_folder()) / "link"
            network = replace(network, local_socket=str(path))
        Service(
            settings,
            network,
            folder,
            tuple(actor),
            is_router=is_router,
            is_remote=client and bool(actor),
            is_state_kept=state is not None,
            metrics_port=metrics_port,
            recording=record,
        ).run()


def record(
    out: Annotated[
        Path,
        tyro.conf.Positional,
        argument(
            metavar="DIR",
            help="folder for the recording, empty or with an earlier one: an MCAP file per actor",
        ),
    ],
    robot: Robot = "robot",
    endpoint: EndpointAddress = DEFAULT_ENDPOINT,
    actor: ActorNames = (),
    config: ConfigFile = None,
    set: Settings = (),
    state: StateFolder = None,
    localize: Localize = None,
    keys: KeysFolder = None,
    insecure: Insecure = False,
    local_socket: LocalSocket = None,
    client: Client = False,
    metrics_port: MetricsPort = None,
    preset: Preset = "",
    device: Device = None,
) -> None:
    """Run the service as `ldo serve` does, and record the inputs of every actor.

    You cannot record a service that already runs, because the recording would lack the state of its
    actors. Stop the service, then run `ldo record` with the same --state folder to keep the map.

    A recording of 640x480 pixels at 30 Hz takes 100 MB per second; the setting recording.max_gb
    limits the size. `ldo replay DIR --verify` replays the recording. Every command that takes a
    SOURCE also accepts DIR as SOURCE.

      ldo record recordings/desk
      ldo publish synthetic:room --rate 15      (in another terminal)
    """
    serve(
        *(robot, endpoint, actor, config, set, state, localize),
        record=out,
        keys=keys,
        insecure=insecure,
        local_socket=local_socket,
        client=client,
        metrics_port=metrics_port,
        preset=preset,
        device=device,
    )


def _usable_socket(path: Path, is_router_with_keys: bool) -> Path:
    """Return the absolute path of the Unix socket of a service.

    Raises:
        ConfigError: The service opens no socket, or the path cannot be used.
    """
    path = path.expanduser().resolve()
    if not is_router_with_keys:
        raise ConfigError(
            "--local-socket needs --keys, and a service that opens its own router. Without keys, "
            "programs on this machine use the address of --endpoint."
        )
    if len(str(path).encode()) > MAX_SOCKET_PATH or any(c in str(path) for c in "?#"):
        raise ConfigError(
            f"--local-socket {path} must have at most {MAX_SOCKET_PATH} bytes and must not contain "
            "? or #. Choose another path."
        )
    try:
        mode = path.parent.stat().st_mode
    except OSError as error:
        raise ConfigError(
            f"--local-socket {path}: the folder {path.parent} cannot be used: {error.strerror}. "
            f"Create it by `mkdir -m 700 {path.parent}`."
        ) from error
    if mode & OTHERS:
        raise ConfigError(
            f"--local-socket {path}: all users of this machine can access the folder "
            f"{path.parent}, and the socket needs no keys. Choose another folder, such as one made "
            f"by `mkdir -m 700 {path.parent / 'ldo'}`."
        )
    if path.exists() and not path.is_socket():
        raise ConfigError(
            f"--local-socket {path} exists and is no socket. Choose a path without a file."
        )
    return path
