"""ldo publish"""

import time
from collections.abc import Iterator
from typing import Annotated

import tyro
from rich.console import Console

from ldo_service.client import connect
from ldo_service.datasets import Sequence
from ldo_service.errors import ConfigError, FrameError
from ldo_service.recordings.sequence import open_source
from ldo_service.runtime.zenoh_transport import DEFAULT_ENDPOINT
from ldo_service.wire import camera_rgbd_message, restamped

from .options import Endpoint, Robot, Source
from .progress import progress
from .run import selected


def publish(
    source: Source,
    robot: Robot = "robot",
    endpoint: Endpoint = DEFAULT_ENDPOINT,
    rate: Annotated[
        float | None, tyro.conf.arg(metavar="HZ", help="frames per second; default: as recorded")
    ] = None,
    stride: Annotated[int, tyro.conf.arg(metavar="N", help="take every n-th frame")] = 1,
    max_frames: Annotated[
        int | None, tyro.conf.arg(metavar="N", help="stop after so many frames")
    ] = None,
    restamp: Annotated[
        bool,
        tyro.conf.arg(help="stamp frames with the time of sending instead of the recorded one"),
    ] = False,
) -> None:
    """Be a camera: publish a sequence's frames on camera/rgbd.

    Stamps are those of the sequence unless --restamp is given: then a subscriber can subtract the
    stamp of a pose from its clock and has the pose's age.

      ldo publish ~/data/rgbd_dataset_freiburg1_desk --rate 15
    """
    if rate is not None and rate <= 0:
        raise ConfigError(f"--rate {rate:g}: must be positive.")
    console = Console(stderr=True)
    sequence = open_source(source)
    indices = selected(stride, max_frames).indices(sequence)
    sent = 0
    with (
        connect(robot, endpoint) as service,
        progress("publish", len(indices), console) as advance,
    ):
        for done, index in enumerate(paced(sequence, indices, rate), 1):
            try:
                raw = sequence.read(index)
            except FrameError as error:
                console.print(f"{error} It is left out.")
                continue
            message = camera_rgbd_message(raw)
            service.send(restamped(message) if restamp else message)
            sent += 1
            advance(done)
    console.print(f"{sent} frames published")


def paced(sequence: Sequence, indices: range, rate: float | None) -> Iterator[int]:
    """Each index when it is due: by its recorded stamp, or `rate` times a second."""
    started_s = time.monotonic()
    first_ns = int(sequence.stamps_ns[indices[0]]) if indices else 0
    for number, index in enumerate(indices):
        due_s = number / rate if rate else (int(sequence.stamps_ns[index]) - first_ns) * 1e-9
        time.sleep(max(0.0, started_s + due_s - time.monotonic()))
        yield index
