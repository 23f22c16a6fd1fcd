"""Camera frames, checked and rectified.                                 actors/frame_source.py

in   camera/rgbd    CameraRgbd    Latest(4)   a burst is smoothed, an old frame is worth less than
                                              the next one
in   camera/color   CameraColor   Latest(4)   the same, for cameras that send two topics: halves
in   camera/depth   CameraDepth   Latest(4)   are paired by stamp
out  frame/rgbd     FrameRgbd                 a pair has the stamp and the number of its colour
"""

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np

from ldo_service.conversions.frames import (
    camera_from_message,
    frame_to_message,
    raw_frame_from_message,
)
from ldo_service.conversions.poses import pose_from_message
from ldo_service.errors import ConfigError, DataError, named
from ldo_service.geometry import codecs
from ldo_service.geometry.frames import RawFrame, Rectifier, in_meters
from ldo_service.geometry.registration import register_depth
from ldo_service.geometry.stamps import StreamPairer
from ldo_service.runtime import Actor, In, Latest, Out
from ldo_service.schemas import CameraColor, CameraDepth, CameraRgbd, FrameRgbd
from ldo_service.schemas.pose import IDENTITY
from ldo_service.schemas.topics import CAMERA_COLOR, CAMERA_DEPTH, CAMERA_RGBD, FRAME_RGBD

log = logging.getLogger(__name__)

Input = CameraRgbd | CameraColor | CameraDepth
# halves without one pair: a second of frames, no start-up effect any more
UNPAIRED_WARNING_COUNT = 30


@dataclass(frozen=True, slots=True)
class FrameSourceConfig:
    max_skew_s: float = 0.015  # between the halves of a pair: under half a period at 30 Hz, so
    # that the first depth within it is the nearest; at 1 rad/s it is 0.9 deg of turn
    pair_buffer: int = 8  # halves of a stream that wait for the other: 0.27 s at 30 Hz, 7 MB VGA
    restart_after_s: float = 1.0  # a stamp so much earlier is no jitter: the camera started again
    min_side_px: int = 32  # smaller images hold too little to track, and hint at a wrong header

    def __post_init__(self) -> None:
        if not 0 <= self.max_skew_s < 10:
            raise ConfigError(f"frame_source.max_skew_s={self.max_skew_s:g}: must be within 0..10.")
        if not self.restart_after_s > 0:
            raise ConfigError(
                f"FrameSourceConfig.restart_after_s={self.restart_after_s:g} must be positive."
            )
        if min(self.pair_buffer, self.min_side_px) < 1:
            raise ConfigError(
                named(self, "pair_buffer", "min_side_px")
                + ": pair_buffer and min_side_px must be at least 1."
            )


class FrameSource(Actor):
    """A frame that cannot be used is counted, and the first of each episode is logged."""

    name = "frame_source"
    inputs = (
        In(CAMERA_RGBD, Latest(4)),
        In(CAMERA_COLOR, Latest(4)),
        In(CAMERA_DEPTH, Latest(4)),
    )
    outputs = (Out(FRAME_RGBD),)
    is_prompt = True

    def __init__(self, config: FrameSourceConfig | None = None) -> None:
        super().__init__()
        self.config = config or FrameSourceConfig()
        self._rectify = Rectifier()
        self._pairing = self._new_pairing()
        self._last_stamp_ns = -1
        self._sessions = 1  # of the camera
        self._rejected = 0
        self._is_rejecting = False
        self._has_warned_of_skew = False

    def handle(self, message: Input) -> Iterator[FrameRgbd]:
        self._notice_restart(message)
        if isinstance(message, CameraRgbd):
            yield from self._frame(message, partial(raw_frame_from_message, message, message.frame))
        else:
            for color, depth in self._pair(message):
                yield from self._frame(color, partial(join_halves, color, depth))

    # --- pairs ------------------------------------------------------------------------------------
    def _pair(self, half: CameraColor | CameraDepth) -> list[tuple[CameraColor, CameraDepth]]:
        try:
            if isinstance(half, CameraColor):
                pairs = list(self._pairing.add_a(half))
            else:
                pairs = list(self._pairing.add_b(half))
        except DataError as error:
            self._reject(half, error)
            return []
        self._warn_when_nothing_pairs()
        return pairs

    def _warn_when_nothing_pairs(self) -> None:
        lost = self._pairing.lost_a + self._pairing.lost_b
        if (
            self._pairing.pairs == 0
            and lost >= UNPAIRED_WARNING_COUNT
            and not self._has_warned_of_skew
        ):
            self._has_warned_of_skew = True
            log.warning(
                "%d colour and %d depth images found no partner within %g ms: do both cameras "
                "stamp by one clock? frame_source.max_skew_s allows more.",
                self._pairing.lost_a, self._pairing.lost_b, 1e3 * self.config.max_skew_s,
            )  # fmt: skip

    # --- frames -----------------------------------------------------------------------------------
    def _frame(
        self, message: CameraRgbd | CameraColor, decoded: Callable[[], RawFrame]
    ) -> Iterator[FrameRgbd]:
        try:
            self._require_later(message)
            self._require_usable(message)
            frame = self._rectify(decoded())
        except DataError as error:
            self._reject(message, error)
            return
        self._is_rejecting = False
        self._last_stamp_ns = message.stamp_ns
        yield frame_to_message(frame)

    def _require_later(self, message: CameraRgbd | CameraColor) -> None:
        if message.stamp_ns <= self._last_stamp_ns:
            raise DataError(
                f"its stamp {message.stamp_ns} ns is not after the last one, "
                f"{self._last_stamp_ns} ns. Send frames in the order of their exposure."
            )

    def _notice_restart(self, message: Input) -> None:
        """A camera that starts again may count time from an earlier point."""
        back_s = (self._last_stamp_ns - message.stamp_ns) * 1e-9
        if back_s > self.config.restart_after_s:
            log.warning("stamps went back by %.1f s: the camera has started again", back_s)
            self._sessions += 1
            self._last_stamp_ns = -1
            self._pairing = self._new_pairing()

    def _new_pairing(self) -> StreamPairer[CameraColor, CameraDepth]:
        return StreamPairer(round(self.config.max_skew_s * 1e9), self.config.pair_buffer)

    def _require_usable(self, message: CameraRgbd | CameraColor) -> None:
        width, height = message.camera.width, message.camera.height
        if min(width, height) < self.config.min_side_px:
            raise DataError(
                f"{width}x{height} pixels are too few to track: a side needs "
                f"{self.config.min_side_px}."
            )

    def _reject(self, message: Input, error: DataError) -> None:
        self._rejected += 1
        if not self._is_rejecting:
            log.warning("frame %d rejected: %s", message.frame, error)
        self._is_rejecting = True

    # --- state ------------------------------------------------------------------------------------
    def snapshot(self) -> dict[str, int]:
        """Without halves that wait: after a crash one pair fewer is cheaper than saving images."""
        return {"last_stamp_ns": self._last_stamp_ns}

    def restore(self, state: dict[str, int]) -> None:  # type: ignore[override]
        self._last_stamp_ns = state["last_stamp_ns"]

    def metrics(self) -> dict[str, float]:
        skews_ms = self._pairing.skews_ms() or [0.0]
        return {
            "frames_rejected": self._rejected,
            "camera_sessions": self._sessions,
            "pairs": self._pairing.pairs,
            "color_unpaired": self._pairing.lost_a,
            "depth_unpaired": self._pairing.lost_b,
            "skew_ms_p50": float(np.median(skews_ms)),  # of the recent pairs
            "skew_ms_max": max(skews_ms),
        }


def join_halves(color: CameraColor, depth: CameraDepth) -> RawFrame:
    """The depth in the colour image, with the colour's stamp, number and camera."""
    image, scale = depth.image, depth.depth_scale
    values = codecs.decode_depth(image.encoding, image.width, image.height, image.data)
    if depth.camera != color.camera or depth.T_color_depth != IDENTITY:
        depth_m = in_meters(values, scale)
        cameras = camera_from_message(depth.camera), camera_from_message(color.camera)
        values, scale = (
            register_depth(depth_m, *cameras, pose_from_message(depth.T_color_depth)),
            1.0,
        )
    image = color.image
    return RawFrame(
        index=color.frame,
        stamp_ns=color.stamp_ns,
        color=codecs.decode_color(image.encoding, image.width, image.height, image.data),
        depth=values,
        depth_scale=scale,
        camera=camera_from_message(color.camera),
    )
