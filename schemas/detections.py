"""Detections in a keyframe."""

import msgspec

from ldo_service.schemas.frames import MAX_PIXELS
from ldo_service.schemas.message import Message, require_count, require_finite

MAX_LABEL_LENGTH = 100  # Characters.
MAX_DETECTIONS = 10_000
TOLERANCE_PX = 1e-3  # Rounding may move a box beyond the image edge by this much.


class Detection(msgspec.Struct, frozen=True, kw_only=True):
    """Box of an object with label and score.

    Pixel centers are at integer coordinates. A box around the single pixel x = 3, y = 5 therefore
    has the edges x0 = 2.5, y0 = 4.5, x1 = 3.5, y1 = 5.5.
    """

    label: str  # Lower case, single spaces; synonyms of a class share one label.
    score: float  # Score of the network, 0..1.
    # Edges x0, y0, x1, y1 in the keyframe's image, pixels.
    box_px: tuple[float, float, float, float]

    def __post_init__(self) -> None:
        if not 0 < len(self.label) <= MAX_LABEL_LENGTH:
            raise ValueError(
                f"label has {len(self.label)} characters, must have 1 to {MAX_LABEL_LENGTH}"
            )
        require_finite("score and box_px", (self.score, *self.box_px))
        if not 0 <= self.score <= 1:
            raise ValueError(f"score is {self.score:g}, must be within 0..1")
        x0, y0, x1, y1 = self.box_px
        if not (x0 < x1 and y0 < y1):
            raise ValueError(f"box_px {self.box_px} is empty: x0 < x1 and y0 < y1 are required")


class DetectionBoxes(Message, frozen=True, kw_only=True):
    """Detections in a keyframe, published on detection/boxes once for every keyframe.

    stamp_ns is the stamp of the keyframe. If no detector ran, `network` and `detections` are empty,
    even if the keyframe shows objects.
    """

    keyframe: int  # Id of the keyframe.
    width: int  # Width of the keyframe's image, pixels.
    height: int  # Height of the keyframe's image, pixels.
    detections: tuple[Detection, ...] = ()  # Sorted by descending score.
    network: str = ""  # Name and checksum of the network that ran; empty if none ran.

    def check(self) -> None:
        require_count("keyframe", self.keyframe)
        if self.width < 1 or self.height < 1 or self.width * self.height > MAX_PIXELS:
            raise ValueError(
                f"image size is {self.width}x{self.height}, must be 1 to {MAX_PIXELS} pixels in "
                "total"
            )
        if len(self.detections) > MAX_DETECTIONS:
            raise ValueError(
                f"message has {len(self.detections)} detections, must have at most {MAX_DETECTIONS}"
            )
        if self.detections and not self.network:
            raise ValueError(
                f"message has {len(self.detections)} detections, but `network` is empty; `network` "
                "must name the network that made the detections"
            )
        for detection in self.detections:
            self._require_inside(detection)

    def _require_inside(self, detection: Detection) -> None:
        x0, y0, x1, y1 = detection.box_px
        low, right, bottom = -0.5 - TOLERANCE_PX, self.width - 0.5, self.height - 0.5
        if min(x0, y0) < low or x1 > right + TOLERANCE_PX or y1 > bottom + TOLERANCE_PX:
            raise ValueError(
                f"box_px {detection.box_px} leaves the image of {self.width}x{self.height} pixels: "
                f"x must be in -0.5..{right}, y in -0.5..{bottom}"
            )
