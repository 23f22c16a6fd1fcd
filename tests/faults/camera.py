"""Camera that moves to and fro in the synthetic room."""

from collections.abc import Callable
from dataclasses import replace
from threading import Event, Thread
from typing import Any

import msgspec
import numpy as np
import zenoh

from ldo_service.client import Client
from ldo_service.conversions.frames import raw_frame_to_message
from ldo_service.datasets import Sequence, open_sequence
from ldo_service.geometry import Camera
from ldo_service.geometry.frames import RawFrame
from ldo_service.schemas import CameraRgbd

STRIDE, PERIOD_NS, FIRST_NS = 2, 100_000_000, 1_000_000_000


def frames(*, is_small: bool = True) -> list[CameraRgbd]:
    """Return the frames of a way there and back, which repeats without a jump.

    Args:
        is_small: Return frames of 160x120 instead of 320x240.
    """
    room = open_sequence("synthetic:room")
    there = [room.read(i) for i in _indices(room)]
    return and_back([raw_frame_to_message(_smaller(raw) if is_small else raw) for raw in there])


def true_poses() -> list[np.ndarray]:
    """Return T_world_camera [4, 4] of each of `frames`."""
    room = open_sequence("synthetic:room")
    truth = room.truth()
    assert truth is not None
    return and_back([truth.T_world_camera[i] for i in _indices(room)])


def _indices(room: Sequence) -> range:
    return range(0, len(room), STRIDE)


def and_back(there: list[Any]) -> list[Any]:
    """Return elements in order and then in reverse order, so that they repeat without a jump."""
    return there + there[-2:0:-1]


def _smaller(raw: RawFrame) -> RawFrame:
    big = raw.camera
    camera = Camera(big.width // 2, big.height // 2, big.fx / 2, big.fy / 2, big.cx / 2, big.cy / 2)
    return replace(raw, camera=camera, color=raw.color[::2, ::2], depth=raw.depth[::2, ::2])


def number_of(stamp_ns: int) -> int:
    """Return the number of frames sent before the one with this stamp."""
    return (stamp_ns - FIRST_NS) // PERIOD_NS


class CameraStream:
    """Thread that sends frames at `rate_hz`, with increasing stamps."""

    def __init__(self, scene: list[CameraRgbd], rate_hz: float) -> None:
        self._scene, self._period_s = scene, 1 / rate_hz
        self._stop, self._thread = Event(), Thread()
        self.sent = 0

    def start(self, client: Client) -> None:
        self._stop.clear()
        self._thread = Thread(target=self._stream, args=(client.send,), daemon=True)
        self._thread.start()

    def stop(self) -> None:
        self._stop.set()
        self._thread.join()

    def skip(self, frames: int) -> None:
        """Move the camera on without sending the frames."""
        self.sent += frames

    @property
    def stamp_ns(self) -> int:
        """Stamp of the next frame, in nanoseconds."""
        return FIRST_NS + self.sent * PERIOD_NS

    def _stream(self, send: Callable[[CameraRgbd], None]) -> None:
        while not self._stop.wait(self._period_s):
            frame = self._scene[self.sent % len(self._scene)]
            try:
                send(msgspec.structs.replace(frame, frame=self.sent, stamp_ns=self.stamp_ns))
            except zenoh.ZError:
                return  # The service and its session have ended.
            self.sent += 1
