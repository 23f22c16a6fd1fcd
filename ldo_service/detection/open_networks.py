"""Detectors and labellers, opened by the name of a registered network, or by a path."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from ldo_service import demo_networks
from ldo_service.detection.labellers.dual_encoder import (
    DualEncoder,
    DualEncoderConfig,
    EncoderFiles,
)
from ldo_service.errors import ConfigError, ModelError

from .detectors import NetworkConfig, OnnxDetector
from .model_registry import CLIP, EMBEDDINGS, FILE, SENTENCE, TEXT, VOCABULARY, Models

# File names of the image encoder in a folder that is not registered, by preference.
IMAGES = (FILE, "image_encoder.onnx")


def open_detector(model: str, config: NetworkConfig) -> OnnxDetector:
    """Open a detector by its registered name or its file.

    The layout and the class names in `config` override the registered ones.

    Args:
        model: `demo`, a registered name, or the path of an ONNX file.
        config: Settings.

    Raises:
        ConfigError: If there is no such model.
        ModelError: If the model cannot be used as a detector.
    """
    if model == demo_networks.NAME:
        return _open_demo_detector(config)
    models = Models()
    if model not in models.names:
        path = Path(model).expanduser()
        if not path.is_file():
            raise ConfigError(
                f"detector.model={model} is neither `demo` (included in the package) nor an "
                f"ONNX file, nor registered in {models.folder}. Registered models: "
                f"{', '.join(models.names) or 'none'}. `ldo models add NAME FILE` registers a "
                "model."
            )
        return OnnxDetector(path, config)
    found = models.get(model)
    found.verify()
    if found.about.layout == CLIP:
        raise ModelError(
            f"{model} is a pair of encoders: set it as vlm_labeller.model, not detector.model."
        )
    if found.about.layout == SENTENCE:
        raise ModelError(f"{model} is a sentence encoder, for `ldo query` only: set a detector.")
    settings = replace(config, layout=config.layout or found.about.layout)
    return OnnxDetector(found.file, settings, found.about.classes, name=model)


def open_labeller(model: str, config: DualEncoderConfig, names: Sequence[str] = ()) -> DualEncoder:
    """Open a pair of encoders by its registered name or a folder with its files.

    Args:
        model: `demo`, a registered name, or a folder with the files that the docstring of
            `model_registry` lists.
        config: Settings.
        names: Labels that the labeller chooses from; empty: the labels registered with the pair, or
            the default of `DualEncoder` for a folder.

    Raises:
        ConfigError: If there is no such model.
        ModelError: If the model cannot be used as a labeller.
    """
    if model == demo_networks.NAME:
        return _open_demo_labeller(config, names)
    models = Models()
    if model not in models.names:
        folder = Path(model).expanduser()
        if not any((folder / file).is_file() for file in IMAGES):
            raise ConfigError(
                f"vlm_labeller.model={model} is neither a folder with {' or '.join(IMAGES)} nor "
                f"registered in {models.folder}. Registered models: "
                f"{', '.join(models.names) or 'none'}. "
                "`ldo models add NAME FILE --embeddings FILE` registers a model."
            )
        return DualEncoder(_pair_in(folder), config, names, name=folder.name)
    found = models.get(model)
    found.verify()
    if found.about.layout == SENTENCE:
        raise ModelError(
            f"{model} is a sentence encoder, for `ldo query` only: set an encoder pair."
        )
    if found.about.layout != CLIP:
        raise ModelError(
            f"{model} is a detector ({found.about.layout}): set it as detector.model, not "
            "vlm_labeller.model."
        )
    return DualEncoder(_pair_in(found.folder), config, names or found.about.classes, name=model)


def _pair_in(folder: Path) -> EncoderFiles:
    """Return the files of the pair in a folder, found by their usual names."""

    def here(*parts: str) -> Path | None:
        return next((folder / part for part in parts if (folder / part).is_file()), None)

    return EncoderFiles(
        here(*IMAGES) or folder / FILE, here(TEXT), here(VOCABULARY), here(*EMBEDDINGS)
    )


def _open_demo_detector(config: NetworkConfig) -> OnnxDetector:
    return OnnxDetector(demo_networks.DETECTOR, config, name=demo_networks.NAME)


def _open_demo_labeller(config: DualEncoderConfig, names: Sequence[str] = ()) -> DualEncoder:
    """Return the built-in labeller, which has a table of text embeddings and no text encoder.

    Args:
        config: Settings. If `config.nothing` is empty, `demo_networks.NOTHING` is used.
        names: Labels that the labeller chooses from; empty: all names of the table.

    Raises:
        ConfigError: If a name is not in the table.
    """
    pair = EncoderFiles(demo_networks.IMAGE_ENCODER, embeddings=demo_networks.TEXT_EMBEDDINGS)
    settings = replace(config, nothing=config.nothing or demo_networks.NOTHING)
    return DualEncoder(pair, settings, names, name=demo_networks.NAME)
