"""The built-in networks for the synthetic scenes; CARD.md beside this says what they score.

They are trained by `networks/train_demo.py` of the repository. `detector.model` and
`vlm_labeller.model` take them by NAME.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from ldo_service.semantics.detectors import NetworkConfig, OnnxDetector
from ldo_service.semantics.labellers.dual_encoder import DualEncoder, DualEncoderConfig, Pair

NAME = "demo"
LICENCE = "Apache-2.0"
DETECTOR = Path(__file__).with_name("detector.onnx")
IMAGE_ENCODER = Path(__file__).with_name("image_encoder.onnx")
TEXT_EMBEDDINGS = Path(__file__).with_name("text_embeddings.npz")
NOTHING = ("wall", "floor", "ceiling", "background")  # names of the table that are no objects

__all__ = [
    "DETECTOR",
    "IMAGE_ENCODER",
    "LICENCE",
    "NAME",
    "NOTHING",
    "TEXT_EMBEDDINGS",
    "open_detector",
    "open_labeller",
]


def open_detector(config: NetworkConfig) -> OnnxDetector:
    return OnnxDetector(DETECTOR, config, name=NAME)


def open_labeller(config: DualEncoderConfig, names: Sequence[str] = ()) -> DualEncoder:
    """To choose from `names`, or from all of the table, but for those of NOTHING.

    Raises ConfigError for a name that is not in the table: there is no text encoder.
    """
    pair = Pair(IMAGE_ENCODER, embeddings=TEXT_EMBEDDINGS)
    settings = replace(config, nothing=config.nothing or NOTHING)
    return DualEncoder(pair, settings, names, name=NAME)
