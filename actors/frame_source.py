"""Check and rectification of camera frames.

Topics, their messages, the delivery policy of each input (with its queue length), and notes:

in   camera/rgbd    CameraRgbd    Latest(4)   buffers a burst of four; drops older frames
in   camera/color   CameraColor   Latest(4)   color image of a camera with two topics
in   camera/depth   CameraDepth   Latest(4)   depth image of such a camera, paired by stamp
out  frame/rgbd     FrameRgbd                 a pair has stamp and number of its color image
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
from ldo_service.geometry.frames import MAX_DEPTH_M, RawFrame, Rectifier, in_meters
from ldo_service.geometry.registration import register_depth
from ldo_service.geometry.stamps import StreamPairer
from ldo_service.runtime import Actor, In, Latest, Out
from ldo_service.schemas import CameraColor, CameraDepth, CameraRgbd, FrameRgbd
from ldo_service.schemas.message import LAST_INTEGER
from ldo_service.schemas.pose import IDENTITY
from ldo_service.schemas.topics import CAMERA_COLOR, CAMERA_DEPTH, CAMERA_RGBD, FRAME_RGBD

log = logging.getLogger(__name__)

Input = CameraRgbd | CameraColor | CameraDepth
# Number of unpaired images before the warning: a second of frames, longer than a start-up effect.
UNPAIRED_WARNING_COUNT = 30
MAX_RESTART_LINES = 10  # Number of camera restarts after which they are only counted.
# Maximum size of the messages of both streams that wait for their partner, bytes: ten raw color
# images of 1080p, or the two images of the largest frame.
PAIR_BUFFER_BYTES = 64_000_000


@dataclass(frozen=True, slots=True)
class FrameSourceConfig:
    """Limits for pairing, restarts and image sizes of a camera."""

    # Maximum time between the color and depth image of a pair. It is below half a frame period at
    # 30 Hz, so that the first depth image within this time is the nearest one. A camera that
    # turns at 1 rad/s rotates by 0.9 deg in this time.
    max_skew_s: float = 0.015
    # Maximum number of images per stream that wait for their partner: 0.27 s at 30 Hz, 7 MB at
    # 640x480.
    pair_buffer: int = 8
    # If stamps go back by more than this time, the camera has restarted; jitter is smaller.
    restart_after_s: float = 1.0
    # Minimum image side. Smaller images lack detail for tracking; usually their header is wrong.
    min_side_px: int = 32

    def __post_init__(self) -> None:
        if not 0 <= self.max_skew_s < 10:
            raise ConfigError(
                f"frame_source.max_skew_s={self.max_skew_s:g} must be at least 0 and below 10."
            )
        if not self.restart_after_s > 0:
            raise ConfigError(
                f"FrameSourceConfig.restart_after_s={self.restart_after_s:g} must be positive."
            )
        if min(self.pair_buffer, self.min_side_px) < 1:
            raise ConfigError(named(self, "pair_buffer", "min_side_px") + " must be at least 1.")


class FrameSource(Actor):
    """Actor that pairs, checks and rectifies camera frames.

    It counts unusable frames. It logs only the first of several unusable frames in a row.
    """

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
        self._sessions = 1  # Number of camera starts so far.
        self._rejected = 0
        self._pixels_too_far = 0  # Pixels whose depth no camera can measure.
        self._is_rejecting = False
        self._has_warned_of_skew = False

    def handle(self, message: Input) -> Iterator[FrameRgbd]:
        """Yield the rectified frames that the message completes.

        An RGB-D message is a complete frame. A color or depth message completes a pair, or waits
        for its partner.
        """
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
                "frame_source: %d color and %d depth images found no partner within %g ms, so no "
                "pair was published. Check that both cameras use one clock, or raise "
                "frame_source.max_skew_s.",
                self._pairing.lost_a, self._pairing.lost_b, 1e3 * self.config.max_skew_s,
            )  # fmt: skip

    # --- frames -----------------------------------------------------------------------------------
    def _frame(
        self, message: CameraRgbd | CameraColor, decoded: Callable[[], RawFrame]
    ) -> Iterator[FrameRgbd]:
        try:
            self._require_later(message)
            self._require_usable(message)
            raw = decoded()
            self._count_too_far(raw)
            frame = self._rectify(raw)
        except DataError as error:
            self._reject(message, error)
            return
        self._is_rejecting = False
        self._last_stamp_ns = message.stamp_ns
        yield frame_to_message(frame)

    def _require_later(self, message: CameraRgbd | CameraColor) -> None:
        if message.stamp_ns <= self._last_stamp_ns:
            raise DataError(
                f"stamp {message.stamp_ns} ns is not after the previous stamp "
                f"{self._last_stamp_ns} ns. Send frames in the order of their exposure; to send a "
                "data set again, use `ldo publish SOURCE --restamp`."
            )

    def _notice_restart(self, message: Input) -> None:
        """Forget the last stamp and all unpaired images if the camera has restarted.

        The camera has restarted if the stamps go back by more than `restart_after_s`.
        """
        back_s = (self._last_stamp_ns - message.stamp_ns) * 1e-9
        if back_s > self.config.restart_after_s:
            if self._sessions < MAX_RESTART_LINES:
                log.warning(
                    "frame_source: stamps went back by %.1f s; assuming that the camera restarted. "
                    "If this repeats, two cameras with different clocks publish frames; stop one "
                    "of them. The metric camera_sessions counts further restarts.",
                    back_s,
                )
            self._sessions += 1
            self._last_stamp_ns = -1
            self._pairing = self._new_pairing()

    def _new_pairing(self) -> StreamPairer[CameraColor, CameraDepth]:
        return StreamPairer(
            round(self.config.max_skew_s * 1e9),
            self.config.pair_buffer,
            size_of=_message_bytes,
            max_bytes=PAIR_BUFFER_BYTES,
        )

    def _require_usable(self, message: CameraRgbd | CameraColor) -> None:
        width, height = message.camera.width, message.camera.height
        if min(width, height) < self.config.min_side_px:
            raise DataError(
                f"the image of {width}x{height} pixels is too small to track: each side must have "
                f"at least {self.config.min_side_px} pixels. Send larger images."
            )

    def _count_too_far(self, raw: RawFrame) -> None:
        if not (count := raw.too_far()):
            return
        if not self._pixels_too_far:
            log.warning(
                "frame_source: frame %d has %d pixels with a depth of %g m or more, which count as "
                "not measured. No action needed if the camera marks missing depth this way; "
                "otherwise check depth_scale. Later pixels are only counted.",
                raw.index, count, MAX_DEPTH_M,
            )  # fmt: skip
        self._pixels_too_far = min(self._pixels_too_far + count, LAST_INTEGER)

    def _reject(self, message: Input, error: DataError) -> None:
        self._rejected += 1
        if not self._is_rejecting:
            log.warning("frame_source: frame %d rejected: %s", message.frame, error)
        self._is_rejecting = True

    # --- state ------------------------------------------------------------------------------------
    def snapshot(self) -> dict[str, int]:
        """Return the last stamp.

        Images that wait for their partner are not saved. A crash therefore loses at most one pair,
        which costs less than saving every image.
        """
        return {"last_stamp_ns": self._last_stamp_ns}

    def restore(self, state: dict[str, int]) -> None:  # type: ignore[override]
        """Continue after the last stamp of a snapshot."""
        self._last_stamp_ns = state["last_stamp_ns"]

    def metrics(self) -> dict[str, float]:
        """Return counters of frames and pairs, and the skew of the recent pairs in milliseconds."""
        skews_ms = self._pairing.skews_ms() or [0.0]
        return {
            "frames_rejected": self._rejected,
            "pixels_too_far": self._pixels_too_far,
            "camera_sessions": self._sessions,
            "pairs": self._pairing.pairs,
            "color_unpaired": self._pairing.lost_a,
            "depth_unpaired": self._pairing.lost_b,
            "skew_ms_p50": float(np.median(skews_ms)),  # Median over the recent pairs.
            "skew_ms_max": max(skews_ms),
        }


def _message_bytes(half: CameraColor | CameraDepth) -> int:
    """Return the size of the memory that a message keeps in use, bytes.

    The image data is a view of the received message, so the whole message stays in memory. This
    includes fields that this version does not know.
    """
    return memoryview(half.image.data.obj).nbytes


def join_halves(color: CameraColor, depth: CameraDepth) -> RawFrame:
    """Join a color image and a depth image into one raw frame.

    Depth is registered to the color image. The frame has the number, the stamp and the camera of
    the color image.

    Raises:
        DataError: An image cannot be decoded.
    """
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
