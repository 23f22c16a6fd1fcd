"""What the detector found in a keyframe."""

import msgspec

from ldo_service.schemas.frames import MAX_PIXELS
from ldo_service.schemas.message import Message, require_count, require_finite

MAX_LABEL_LENGTH = 100  # characters
MAX_DETECTIONS = 10_000
TOLERANCE_PX = 1e-3  # of rounding, beyond the edge of the image


class Detection(msgspec.Struct, frozen=True, kw_only=True):
    """One box. Pixel centres are at integer coordinates: a box around pixel (3, 5) alone is
    2.5, 4.5, 3.5, 5.5."""

    label: str  # in lower case, single spaces; words for the same class are one
    score: float  # 0..1, as the network has it
    box_px: tuple[float, float, float, float]  # x0, y0, x1, y1 in the image of the keyframe

    def __post_init__(self) -> None:
        if not 0 < len(self.label) <= MAX_LABEL_LENGTH:
            raise ValueError(f"a label of {len(self.label)} characters: 1 to {MAX_LABEL_LENGTH}")
        require_finite("score and box_px", (self.score, *self.box_px))
        if not 0 <= self.score <= 1:
            raise ValueError(f"score {self.score:g} must be within 0..1")
        x0, y0, x1, y1 = self.box_px
        if not (x0 < x1 and y0 < y1):
            raise ValueError(f"box {self.box_px} is empty")


class DetectionBoxes(Message, frozen=True, kw_only=True):
    """detection/boxes: one message for every keyframe. stamp_ns is that of the keyframe.

    Without a network nobody looked, and that there are no boxes says nothing.
    """

    keyframe: int  # id
    width: int  # of the image, pixels
    height: int
    detections: tuple[Detection, ...] = ()  # the most certain first
    network: str = ""  # name and checksum of the network that looked; empty: nobody did

    def check(self) -> None:
        require_count("keyframe", self.keyframe)
        if self.width < 1 or self.height < 1 or self.width * self.height > MAX_PIXELS:
            raise ValueError(f"image size {self.width}x{self.height} is empty or over {MAX_PIXELS}")
        if len(self.detections) > MAX_DETECTIONS:
            raise ValueError(f"{len(self.detections)} detections are over {MAX_DETECTIONS}")
        if self.detections and not self.network:
            raise ValueError("there are detections, and no network that made them")
        for detection in self.detections:
            self._require_inside(detection)

    def _require_inside(self, detection: Detection) -> None:
        x0, y0, x1, y1 = detection.box_px
        low, right, bottom = -0.5 - TOLERANCE_PX, self.width - 0.5, self.height - 0.5
        if min(x0, y0) < low or x1 > right + TOLERANCE_PX or y1 > bottom + TOLERANCE_PX:
            raise ValueError(
                f"box {detection.box_px} leaves the image of {self.width}x{self.height}"
            )
