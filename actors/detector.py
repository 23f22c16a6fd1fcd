"""Detection of objects of known classes in each keyframe.

Topics, their messages, the delivery policy of each input (with its queue length), and notes:

in   keyframe/new      Keyframe         Backlog(4)    a lost keyframe would get no detections
out  detection/boxes   DetectionBoxes                 one for every keyframe, possibly empty

The service continues if the network cannot be loaded or fails. The detector then publishes messages
without boxes, and its metrics report the failure.
"""

import logging
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from ldo_service.conversions.objects import detections_to_message
from ldo_service.detection.detectors import Detections, NetworkConfig
from ldo_service.detection.open_networks import open_detector
from ldo_service.errors import ConfigError, ModelError
from ldo_service.runtime import Actor, Backlog, In, Out
from ldo_service.schemas import DetectionBoxes, Keyframe
from ldo_service.schemas.topics import DETECTION_BOXES, KEYFRAME_NEW

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class DetectorConfig:
    """Choice and parameters of the detector's network."""

    model: str = ""  # A name of `ldo models list`, or an ONNX file; empty: no detections.
    network: NetworkConfig = field(default_factory=NetworkConfig)


class Detector(Actor):
    """Actor that detects objects in keyframes.

    It has no state, so a keyframe that is sent again gets the same boxes.
    """

    name = "detector"
    inputs = (In(KEYFRAME_NEW, Backlog(4)),)
    outputs = (Out(DETECTION_BOXES),)
    is_backend = True

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
            log.error("detector disabled: %s Keyframes get no detections.", error)

    def handle(self, message: Keyframe) -> Iterator[DetectionBoxes]:
        """Yield the detections of the keyframe in one message.

        If the detector has no network or inference fails, the message has no boxes and its field
        `network` is empty.
        """
        if self._network is None:
            yield detections_to_message(message, None, (), "")
            return
        found = self._find(message.color.numpy())
        yield detections_to_message(message, found, self._network.labels, self._network.identity)

    def _find(self, image: np.ndarray) -> Detections | None:
        """Return the detections in an RGB image [H, W, 3], uint8, or None if the network fails.

        The first failure is logged; further ones are logged only after a success.
        """
        assert self._network is not None
        try:
            found = self._network.detect(image)
        except ModelError as error:
            if not self._is_failing:
                log.error(
                    "detector: inference with the network %s failed: %s Keyframes get no "
                    "detections until inference succeeds.",
                    self._network.identity,
                    error,
                )
            self._is_failing = True
            self._failures += 1
            return None
        self._is_failing = False
        self._boxes += len(found)
        return found

    def metrics(self) -> dict[str, float]:
        """Return counters; `networks_missing` is 1 if the configured network cannot be used."""
        return {
            "networks": float(self._network is not None),
            "networks_missing": float(bool(self.config.model) and self._network is None),
            "inferences_failed": self._failures,
            "boxes": self._boxes,
            **(self._network.metrics() if self._network else {}),
        }


def require_detector(config: DetectorConfig) -> None:
    """Check that the configured model can be used.

    An offline run calls this function first, and does not start after an error. A live service
    starts without detections instead.

    Raises:
        ConfigError: The model is unknown or unusable.
    """
    if config.model:
        open_detector(config.model, config.network)
