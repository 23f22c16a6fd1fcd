"""Built-in detector and labeller networks for the synthetic scenes; CARD.md lists their scores.

The script `training/train_demo.py` of the repository trains them. The settings `detector.model` and
`vlm_labeller.model` select them with the value `demo`. `ldo_service.detection.model_registry`
opens them.
"""

from pathlib import Path

NAME = "demo"
LICENSE = "Apache-2.0"
DETECTOR = Path(__file__).with_name("detector.onnx")
IMAGE_ENCODER = Path(__file__).with_name("image_encoder.onnx")
TEXT_EMBEDDINGS = Path(__file__).with_name("text_embeddings.npz")
NOTHING = ("wall", "floor", "ceiling", "background")  # Names in the table that are no objects.

__all__ = [
    "DETECTOR",
    "IMAGE_ENCODER",
    "LICENSE",
    "NAME",
    "NOTHING",
    "TEXT_EMBEDDINGS",
]
