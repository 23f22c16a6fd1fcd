"""Camera frames, checked and rectified.                                 actors/frame_source.py

in   camera/rgbd   CameraRgbd   Latest(4)   a burst is smoothed, an old frame is worth less than
                                            the next one
out  frame/rgbd    FrameRgbd
"""

import logging
from collections.abc import Iterator

from ldo_service.errors import DataError
from ldo_service.geometry import RgbdFrame
from ldo_service.geometry.rectify import Rectifier
from ldo_service.runtime import Actor, In, Latest, Out
from ldo_service.schemas import CameraRgbd, FrameRgbd
from ldo_service.schemas.topics import CAMERA_RGBD, FRAME_RGBD
from ldo_service.wire import raw_frame_of, rgbd_message

log = logging.getLogger(__name__)


class FrameSource(Actor):
    """A frame that cannot be used is counted, and the first of each episode is logged."""

    name = "frame_source"
    inputs = (In(CAMERA_RGBD, Latest(4)),)
    outputs = (Out(FRAME_RGBD),)

    def __init__(self) -> None:
        super().__init__()
        self._rectify = Rectifier()
        self._last_stamp_ns = -1
        self._rejected = 0
        self._is_rejecting = False

    def handle(self, message: CameraRgbd) -> Iterator[FrameRgbd]:
        try:
            self._require_later(message)
            frame = self._rectified(message)
        except DataError as error:
            self._reject(message, error)
            return
        self._is_rejecting = False
        self._last_stamp_ns = message.stamp_ns
        yield rgbd_message(frame)

    def _require_later(self, message: CameraRgbd) -> None:
        if message.stamp_ns <= self._last_stamp_ns:
            raise DataError(
                f"its stamp {message.stamp_ns} ns is not after the last one, "
                f"{self._last_stamp_ns} ns. Send frames in the order of their exposure."
            )

    def _rectified(self, message: CameraRgbd) -> RgbdFrame:
        return self._rectify(raw_frame_of(message, message.frame))

    def _reject(self, message: CameraRgbd, error: DataError) -> None:
        self._rejected += 1
        if not self._is_rejecting:
            log.warning("frame %d rejected: %s", message.frame, error)
        self._is_rejecting = True

    def snapshot(self) -> dict[str, int]:
        return {"last_stamp_ns": self._last_stamp_ns}

    def restore(self, state: dict[str, int]) -> None:  # type: ignore[override]
        self._last_stamp_ns = state["last_stamp_ns"]

    def facts(self) -> dict[str, float]:
        return {"frames_rejected": self._rejected}
