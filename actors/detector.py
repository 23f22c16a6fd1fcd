"""Objects of known classes in each keyframe.                                actors/detector.py

in   keyframe/new      Keyframe         Lossless(8)   a missing one has no labels from here
out  detection/boxes   DetectionBoxes   one for every keyframe, also where nobody could look

A network that cannot be used never ends the service: it goes on without boxes, and health says so.
"""

import logging
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from ldo_service.conversions.objects import detections_to_message
from ldo_service.detection.detectors import Detections, NetworkConfig
from ldo_service.detection.model_registry import open_detector
from ldo_service.errors import ConfigError, ModelError
from ldo_service.runtime import Actor, In, Lossless, Out
from ldo_service.schemas import DetectionBoxes, Keyframe
from ldo_service.schemas.topics import DETECTION_BOXES, KEYFRAME_NEW

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class DetectorConfig:
    model: str = ""  # a name of `ldo models list`, or an ONNX file; empty: nothing is detected
    network: NetworkConfig = field(default_factory=NetworkConfig)


class Detector(Actor):
    """Has no memory: the same keyframe, sent again, has the same boxes."""

    name = "detector"
    inputs = (In(KEYFRAME_NEW, Lossless(8)),)
    outputs = (Out(DETECTION_BOXES),)

    def __init__(self, config: DetectorConfig | None = None) -> None:
        super().__init__()
        self.config = config or DetectorConfig()
        self._network = None
        self._is_failing = False
        self._failures = self._boxes = 0
        try:
            if self.config.model:
                self._network = open_detector(self.config.model, self.config.network)
        except ConfigError as error:
            log.error("nothing is detected: %s", error)

    def handle(self, message: Keyframe) -> Iterator[DetectionBoxes]:
        if self._network is None:
            yield detections_to_message(message, None, (), "")
            return
        found = self._find(message.color.numpy())
        yield detections_to_message(message, found, self._network.labels, self._network.identity)

    def _find(self, image: np.ndarray) -> Detections | None:
        """None when the network fails, which is logged once until it works again."""
        assert self._network is not None
        try:
            found = self._network.detect(image)
        except ModelError as error:
            if not self._is_failing:
                log.error("keyframes stay without boxes: %s: %s", self._network.identity, error)
            self._is_failing = True
            self._failures += 1
            return None
        self._is_failing = False
        self._boxes += len(found)
        return found

    def metrics(self) -> dict[str, float]:
        """`networks_missing`: named in the configuration, and cannot be used."""
        return {
            "networks": float(self._network is not None),
            "networks_missing": float(bool(self.config.model) and self._network is None),
            "inferences_failed": self._failures,
            "boxes": self._boxes,
        }


def require_detector(config: DetectorConfig) -> None:
    """Raises ConfigError when its model cannot be used: a run over a file is asked for it, where a
    service rather goes on without."""
    if config.model:
        open_detector(config.model, config.network)
