"""Regions that are to be named from an open vocabulary, and their names."""

from ldo_service.schemas.detections import MAX_LABEL_LENGTH
from ldo_service.schemas.frames import Image
from ldo_service.schemas.message import Message, require_count, require_finite

MAX_CROPS = 8
MAX_ALTERNATIVES = 8  # guesses beside the label
MAX_CROP_PX = 1 << 20  # of one crop: networks look at 0.1 megapixels
MAX_NAMES = 10_000
Box = tuple[float, float, float, float]


class LabelRequest(Message, frozen=True, kw_only=True):
    """label/request: what is this? stamp_ns is that of the keyframe."""

    region: int  # id; a newer request of the same region replaces one that waits
    keyframe: int  # id: the newest one that shows the region
    box_px: Box  # x0, y0, x1, y1 in that keyframe's image, as in detection/boxes
    crops: tuple[Image, ...]  # colour, of the region's best views, the best first
    label: str = ""  # what the detector takes it for; empty: nothing
    score: float = 0.0  # 0..1, the detector's

    def check(self) -> None:
        require_count("region", self.region)
        require_count("keyframe", self.keyframe)
        require_finite("box_px", self.box_px)
        x0, y0, x1, y1 = self.box_px
        if not (x0 < x1 and y0 < y1):
            raise ValueError(f"box {self.box_px} is empty")
        if not 0 < len(self.crops) <= MAX_CROPS:
            raise ValueError(f"{len(self.crops)} crops: 1 to {MAX_CROPS}")
        for crop in self.crops:
            _require_crop(crop)
        _require_opinion(self.label, self.score)


class LabelResult(Message, frozen=True, kw_only=True):
    """label/result: the labels of a region. stamp_ns, region and keyframe are those of
    the request, which may be long ago."""

    region: int
    keyframe: int
    label: str  # in lower case, single spaces; empty: it has no opinion, or could not look
    confidence: float  # 0..1; 0 without a label
    labeller: str = ""  # which one looked; empty: none could
    # Other labels and their confidence 0..1, the likelier first.
    alternatives: tuple[tuple[str, float], ...] = ()

    def check(self) -> None:
        require_count("region", self.region)
        require_count("keyframe", self.keyframe)
        _require_opinion(self.label, self.confidence)
        if self.label and not self.labeller:
            raise ValueError("there is a label, and no labeller that gave it")
        if len(self.alternatives) > MAX_ALTERNATIVES:
            raise ValueError(f"{len(self.alternatives)} alternatives are over {MAX_ALTERNATIVES}")
        for other in self.alternatives:
            _require_opinion(*other)
        names = [self.label, *(name for name, _ in self.alternatives)]
        if self.alternatives and (not all(names) or len(set(names)) < len(names)):
            raise ValueError(
                f"label and alternatives are {names}: each is told once, and none is empty"
            )


class AddLabel(Message, frozen=True, kw_only=True):
    """label/add: asked of the labeller, to choose from one more name. stamp_ns tells requests
    apart."""

    name: str

    def check(self) -> None:
        if not 0 < len(self.name.strip()) <= MAX_LABEL_LENGTH:
            raise ValueError(f"a name of {len(self.name)} characters: 1 to {MAX_LABEL_LENGTH}")


class LabelNames(Message, frozen=True, kw_only=True):
    """label/names: after each label/add, whose stamp_ns it has."""

    names: tuple[str, ...]  # that the labeller chooses from; empty: any, or there is none
    error: str = ""  # why what was asked last was not done; empty: it was

    def check(self) -> None:
        if len(self.names) > MAX_NAMES:
            raise ValueError(f"{len(self.names)} names are over {MAX_NAMES}")


def _require_crop(crop: Image) -> None:
    if crop.encoding not in ("rgb8", "bgr8", "jpeg", "png"):
        raise ValueError(f"a crop cannot be encoded as {crop.encoding}")
    if crop.width * crop.height > MAX_CROP_PX:
        raise ValueError(f"a crop of {crop.width}x{crop.height} is over {MAX_CROP_PX} pixels")


def _require_opinion(label: str, score: float) -> None:
    require_finite("confidence", (score,))
    if len(label) > MAX_LABEL_LENGTH:
        raise ValueError(f"a label of {len(label)} characters: at most {MAX_LABEL_LENGTH}")
    if not 0 <= score <= 1:
        raise ValueError(f"confidence {score:g} must be within 0..1")
    if score > 0 and not label:
        raise ValueError(f"a confidence of {score:g}, and no label")
