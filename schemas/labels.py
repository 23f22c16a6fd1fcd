"""Open-vocabulary labels of image regions: requests, results and the names to choose from."""

from ldo_service.schemas.detections import MAX_LABEL_LENGTH
from ldo_service.schemas.frames import Image
from ldo_service.schemas.message import Message, require_count, require_finite

MAX_CROPS = 8
MAX_ALTERNATIVES = 8  # Maximum number of labels in addition to the first one.
MAX_CROP_PX = 1 << 20  # Maximum width times height of a crop; networks use 0.1 megapixels.
MAX_NAMES = 10_000
Box = tuple[float, float, float, float]  # x0, y0, x1, y1 in pixels; pixel centers at integers.


class LabelRequest(Message, frozen=True, kw_only=True):
    """Request to the labeller for the label of an image region, published on label/request.

    stamp_ns is the stamp of `keyframe`.
    """

    # Id of the region. A newer request for the same region replaces a request that still waits.
    region: int
    keyframe: int  # Id of the newest keyframe that shows the region.
    box_px: Box  # Edges x0, y0, x1, y1 in that keyframe's image, pixels, as in detection/boxes.
    # Color images of the region, cropped from the keyframes that show it best, the best first.
    crops: tuple[Image, ...]
    label: str = ""  # Label from the detector; empty if there is none.
    score: float = 0.0  # Score of the detector, 0..1.

    def check(self) -> None:
        require_count("region", self.region)
        require_count("keyframe", self.keyframe)
        require_finite("box_px", self.box_px)
        x0, y0, x1, y1 = self.box_px
        if not (x0 < x1 and y0 < y1):
            raise ValueError(f"box_px {self.box_px} is empty: x0 < x1 and y0 < y1 are required")
        if not 0 < len(self.crops) <= MAX_CROPS:
            raise ValueError(f"request has {len(self.crops)} crops, must have 1 to {MAX_CROPS}")
        for crop in self.crops:
            _require_crop(crop)
        _require_opinion(self.label, self.score)


class LabelResult(Message, frozen=True, kw_only=True):
    """Label of a region, published on label/result.

    stamp_ns, region and keyframe are those of the request, which may be much older than the result.
    """

    region: int
    keyframe: int
    label: str  # Lower case, single spaces; empty if there is no label or no labeller ran.
    confidence: float  # Confidence of the label, 0..1; 0 without a label.
    labeller: str = ""  # Identity of the labeller; empty if no labeller ran.
    # Other labels with their confidence 0..1, the likeliest first.
    alternatives: tuple[tuple[str, float], ...] = ()

    def check(self) -> None:
        require_count("region", self.region)
        require_count("keyframe", self.keyframe)
        _require_opinion(self.label, self.confidence)
        if self.label and not self.labeller:
            raise ValueError(
                f"result has the label {self.label!r} and an empty labeller; `labeller` must name "
                "the labeller that gave the label"
            )
        if len(self.alternatives) > MAX_ALTERNATIVES:
            raise ValueError(
                f"result has {len(self.alternatives)} alternatives, must have at most "
                f"{MAX_ALTERNATIVES}"
            )
        for other in self.alternatives:
            _require_opinion(*other)
        names = [self.label, *(name for name, _ in self.alternatives)]
        if self.alternatives and (not all(names) or len(set(names)) < len(names)):
            raise ValueError(
                f"label and alternatives are {names}: all must be different, and none may be empty"
            )


class AddLabel(Message, frozen=True, kw_only=True):
    """Request, published on label/add, to add a name to the names that the labeller chooses from.

    stamp_ns identifies the request. The reply on label/names has the same stamp.
    """

    name: str  # Name to add, 1 to 100 characters.

    def check(self) -> None:
        if not self.name.strip() or len(self.name) > MAX_LABEL_LENGTH:
            raise ValueError(
                f"name has {len(self.name)} characters, must have 1 to {MAX_LABEL_LENGTH}, and not "
                "only spaces"
            )


class LabelNames(Message, frozen=True, kw_only=True):
    """Reply to a request on label/add, published on label/names.

    stamp_ns is the stamp of the request.
    """

    # Names that the labeller chooses from; empty if any name is possible, or without a labeller.
    names: tuple[str, ...]
    error: str = ""  # Reason why the request failed; empty if the request succeeded.

    def check(self) -> None:
        if len(self.names) > MAX_NAMES:
            raise ValueError(f"message has {len(self.names)} names, must have at most {MAX_NAMES}")


def _require_crop(crop: Image) -> None:
    if crop.encoding not in ("rgb8", "bgr8", "jpeg", "png"):
        raise ValueError(
            f"a crop cannot be encoded as {crop.encoding}; use rgb8, bgr8, jpeg or png"
        )
    if crop.width * crop.height > MAX_CROP_PX:
        raise ValueError(
            f"crop is {crop.width}x{crop.height}, must have at most {MAX_CROP_PX} pixels in total"
        )


def _require_opinion(label: str, score: float) -> None:
    require_finite("score or confidence", (score,))
    if len(label) > MAX_LABEL_LENGTH:
        raise ValueError(f"label has {len(label)} characters, must have at most {MAX_LABEL_LENGTH}")
    if not 0 <= score <= 1:
        raise ValueError(f"score or confidence is {score:g}, must be within 0..1")
    if score > 0 and not label:
        raise ValueError(f"score or confidence is {score:g} without a label, must be 0")
