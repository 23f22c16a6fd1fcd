"""Registered sentence encoders, which compare the text of a query with names of objects.

<folder>/<name>/model.onnx                     copy of the network
<folder>/<name>/tokenizer.json or vocab.txt    copy of its tokenizer
"""

import shutil
from pathlib import Path

import msgspec
import numpy as np

from ldo_service.errors import ModelError

from .model_registry import ABOUT, FILE, SENTENCE, Model, ModelInfo, Models
from .onnx_network import sha256
from .sentence_encoder import SentenceEncoder

TOKENIZER_JSON, TOKENIZER_TEXT = "tokenizer.json", "vocab.txt"
# Names with a synonym of each. With a tokenizer of another network, tokens get the wrong vectors,
# and the synonym of a name is not nearest to it.
SYNONYMS = {"couch": "sofa", "bicycle": "bike", "airplane": "aeroplane", "cup": "mug"}
SYNONYMS |= {"refrigerator": "fridge", "person": "human", "tv": "television", "cat": "kitten"}
MIN_NEAREST = 6  # Minimum synonyms that are nearest to their name; 1 of 8 is chance.


def add_sentence_encoder(
    models: Models, name: str, file: Path, tokenizer: Path, license: str = ""
) -> Model:
    """Copy a sentence encoder into the registry; a failure leaves no files behind.

    Args:
        models: The registry.
        name: Name of the model.
        file: The network in ONNX.
        tokenizer: File of its tokenizer.
        license: Text of the license; empty if unknown.

    Raises:
        ConfigError: If the name is invalid or taken, or the folder cannot be written.
        ModelError: If the files cannot be used as a sentence encoder.
    """

    def fill(folder: Path) -> ModelInfo:
        try:
            _require_synonyms(SentenceEncoder(file, tokenizer))
        except ModelError as error:
            raise ModelError(
                f"{file} cannot be used as a sentence encoder with the tokenizer {tokenizer}: "
                f"{error}"
            ) from error
        part = TOKENIZER_JSON if tokenizer.suffix == ".json" else TOKENIZER_TEXT
        folder.mkdir()
        shutil.copyfile(file, folder / FILE)
        shutil.copyfile(tokenizer, folder / part)
        about = ModelInfo(
            sha256=sha256(folder / FILE),
            layout=SENTENCE,
            classes=(),
            license=license,
            source=file.name,
            parts={part: sha256(folder / part)},
        )
        (folder / ABOUT).write_bytes(msgspec.json.format(msgspec.json.encode(about), indent=1))
        return about

    return models.register(name, [file, tokenizer], fill)


def sentence_encoders(models: Models) -> list[str]:
    """Return the names of the registered sentence encoders, sorted."""
    found = []
    for name in models.names:
        try:
            if models.get(name).about.layout == SENTENCE:
                found.append(name)
        except ModelError:
            continue  # `ldo models list` and `ldo doctor` report the damaged description.
    return found


def open_sentence_encoder(models: Models, name: str) -> SentenceEncoder:
    """Open a registered sentence encoder.

    Raises:
        ConfigError: If the name is not registered.
        ModelError: If the model is damaged or is not a sentence encoder.
    """
    model = models.get(name)
    model.verify()
    parts = [part for part in (TOKENIZER_JSON, TOKENIZER_TEXT) if part in model.about.parts]
    if model.about.layout != SENTENCE or not parts:
        raise ModelError(
            f"{name} is not a sentence encoder but {model.about.layout}: choose another model."
        )
    return SentenceEncoder(model.file, model.folder / parts[0])


def _require_synonyms(encoder: SentenceEncoder) -> None:
    """Check that synonyms are near each other.

    Raises:
        ModelError: If they are not, for example because the tokenizer belongs to another network.
    """
    cosines = encoder.encode([*SYNONYMS.values()]) @ encoder.encode([*SYNONYMS]).T
    nearest = int((cosines.argmax(axis=1) == np.arange(len(SYNONYMS))).sum())
    if nearest < MIN_NEAREST:
        raise ModelError(
            f"the network does not map English synonyms to similar vectors: {nearest} of "
            f"{len(SYNONYMS)} words, such as sofa, are nearest to their synonym, and {MIN_NEAREST} "
            "are required. Check that the tokenizer belongs to this network, and that the network "
            "was trained to compare English texts."
        )
