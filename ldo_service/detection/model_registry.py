"""Registry of the user's networks (`ldo models`). Only `demo` comes with the package.

    <folder>/<name>/model.onnx    copy of the registered detector or image encoder
    <folder>/<name>/about.json    checksum, layout, classes, license

A labeller is a pair of an image encoder and a text encoder, as in CLIP. The folder of a pair also
has the text encoder and the table of byte pairs of its tokenizer:

    <folder>/<name>/text.onnx
    <folder>/<name>/bpe.txt.gz

Precomputed text embeddings may replace these two files:

    <folder>/<name>/embeddings.npz or embeddings.safetensors

The environment variable LDO_MODELS gives <folder>, which is ldo/models in XDG_DATA_HOME by default.
"""

import os
import re
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from ldo_service import demo_networks
from ldo_service.detection.labellers.dual_encoder import (
    DualEncoder,
    DualEncoderConfig,
    EncoderFiles,
)
from ldo_service.errors import ConfigError, ModelError
from ldo_service.storage.atomic_write import folder_made_atomically

from .detectors import NetworkConfig, OnnxDetector
from .onnx_network import sha256

NAME_PATTERN = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
FILE, ABOUT = "model.onnx", "about.json"
TEXT, VOCABULARY = "text.onnx", "bpe.txt.gz"
EMBEDDINGS = ("embeddings.npz", "embeddings.safetensors", "text_embeddings.npz")
CLIP = "clip"  # Value of `ModelInfo.layout` for a pair of encoders.
SENTENCE = "sentence"  # Value of `ModelInfo.layout` for a sentence encoder (`sentence_models`).


class ModelInfo(msgspec.Struct, frozen=True, kw_only=True):
    """Description of a registered network, as stored in about.json."""

    sha256: str  # Checksum of model.onnx, hexadecimal.
    layout: str  # Layout of the detector, see `yolo`, or "clip" or "sentence".
    classes: tuple[str, ...]  # Names of the classes, or of the labels of a labeller.
    license: str = ""  # Text of the license; empty if not stated.
    source: str = ""  # Name of the file that was copied.
    parts: dict[str, str] = {}  # Checksums of the other files of a pair, by file name.


@dataclass(frozen=True, slots=True)
class Model:
    """Registered network: name, folder and description."""

    name: str
    folder: Path
    about: ModelInfo

    @property
    def summary(self) -> str:
        """Layout and number of classes; "sentence encoder" for a sentence encoder."""
        if self.about.layout == SENTENCE:
            return "sentence encoder"
        return f"{self.about.layout}, {len(self.about.classes)} classes"

    @property
    def file(self) -> Path:
        """Path of the ONNX file: the detector, or the image encoder of a labeller."""
        return self.folder / FILE

    def verify(self) -> None:
        """Compare the files with their checksums.

        Raises:
            ModelError: If a file differs from the one that was registered.
        """
        for part, registered in {FILE: self.about.sha256, **self.about.parts}.items():
            try:
                is_whole = sha256(self.folder / part) == registered
            except OSError:
                is_whole = False
            if not is_whole:
                raise ModelError(
                    f"{self.folder / part} is not the file registered as {self.name}: it is "
                    f"missing, damaged or replaced. Run `ldo models remove {self.name}` and add "
                    "the model again."
                )


class Models:
    """Registry of networks in a folder; by default, in `default_folder`."""

    def __init__(self, folder: Path | None = None) -> None:
        self.folder = folder or default_folder()

    def add(self, name: str, file: Path, config: NetworkConfig, license: str = "") -> Model:
        """Copy a detector into the folder and register it; a failure leaves no files behind.

        Args:
            name: Name of the model.
            file: ONNX file of the detector.
            config: Settings of the trial run that checks the file.
            license: Text of the detector's license; empty if unknown.

        Raises:
            ConfigError: If the name is invalid or taken, or the folder cannot be written.
            ModelError: If the file cannot be used as a detector.
        """
        return self.register(name, [file], lambda folder: _fill(folder, file, config, license))

    def add_pair(
        self,
        name: str,
        pair: EncoderFiles,
        config: DualEncoderConfig,
        names: Sequence[str] = (),
        license: str = "",
    ) -> Model:
        """Copy and register a pair of encoders for a labeller; see `add` and `DualEncoder`.

        Args:
            name: Name of the model.
            pair: Files of the pair.
            config: Settings of the trial run that checks the files.
            names: Labels that the labeller chooses from, stored with the pair; empty: the names in
                the pair's file of embeddings or, without such a file, the 80 names of COCO.
            license: Text of the license of the pair; empty if unknown.

        Raises:
            ConfigError: If the name is invalid or taken, or the folder cannot be written.
            ModelError: If the files cannot be used as a pair.
        """
        files = [file for file in (pair.image, pair.text, pair.vocabulary, pair.embeddings) if file]
        return self.register(
            name, files, lambda folder: _fill_pair(folder, pair, config, names, license)
        )

    def register(
        self, name: str, files: Sequence[Path], fill: Callable[[Path], ModelInfo]
    ) -> Model:
        """Add a model whose folder `fill` makes from `files`; a failure leaves no files behind.

        Raises:
            ConfigError: If the name is invalid or taken, or the folder cannot be written.
            ModelError: If a file does not exist, or `fill` rejects it.
        """
        _require_name(name)
        if (self.folder / name).exists():
            raise ConfigError(
                f"there is a model {name!r} already: run `ldo models remove {name}`, or choose "
                "another name."
            )
        for file in files:
            if not file.is_file():
                raise ModelError(f"{file} is not a file: give the path of an existing file.")
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            with folder_made_atomically(self.folder / name) as folder:
                about = fill(folder)
        except OSError as error:
            raise ConfigError(
                f"{self.folder} cannot be written: {error}. Set LDO_MODELS to another folder."
            ) from error
        return Model(name, self.folder / name, about)

    def remove(self, name: str) -> None:
        """Remove a registered network.

        Raises:
            ConfigError: If the name is not registered, or its folder cannot be removed.
        """
        self._require_known(name)
        try:
            shutil.rmtree(self.folder / name)
        except OSError as error:
            raise ConfigError(
                f"{self.folder / name} cannot be removed: {error}. Delete the folder yourself."
            ) from error

    def get(self, name: str) -> Model:
        """Return a registered network.

        Raises:
            ConfigError: If the name is not registered.
            ModelError: If its description cannot be read.
        """
        self._require_known(name)
        folder = self.folder / name
        try:
            values = msgspec.json.decode((folder / ABOUT).read_bytes(), type=dict[str, Any])
            if "licence" in values:  # Written by version 0.1.
                values["license"] = values.pop("licence")
            about = msgspec.convert(values, ModelInfo)
        except (OSError, msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            raise ModelError(
                f"{folder / ABOUT} cannot be read ({error}): run `ldo models remove {name}` and "
                "add the model again."
            ) from error
        return Model(name, folder, about)

    @property
    def names(self) -> list[str]:
        """Names of the registered networks, sorted."""
        try:
            entries = sorted(self.folder.iterdir())
        except OSError:
            return []
        return [
            entry.name for entry in entries if NAME_PATTERN.fullmatch(entry.name) and entry.is_dir()
        ]

    def _require_known(self, name: str) -> None:
        if name not in self.names:
            known = ", ".join(self.names) or "none"
            raise ConfigError(
                f"no model is registered as {name!r} in {self.folder}; registered: {known}. "
                "`ldo models add NAME FILE` registers one."
            )


def default_folder() -> Path:
    """Return the folder of the user's networks.

    The environment variable LDO_MODELS gives the folder; by default, it is ldo/models in the XDG
    base directory for data.
    """
    if folder := os.environ.get("LDO_MODELS"):
        return Path(folder).expanduser()
    data = os.environ.get("XDG_DATA_HOME") or os.path.expanduser("~/.local/share")
    return Path(data) / "ldo" / "models"


def _fill_pair(
    folder: Path, pair: EncoderFiles, config: DualEncoderConfig, names: Sequence[str], license: str
) -> ModelInfo:
    """Check a pair, copy its files into a new folder and write its description there."""
    labeller = DualEncoder(pair, config, names)
    suffix = pair.embeddings.suffix if pair.embeddings else ""
    embeddings = next((part for part in EMBEDDINGS if part.endswith(suffix)), EMBEDDINGS[0])
    copies = {FILE: pair.image, TEXT: pair.text, VOCABULARY: pair.vocabulary}
    copies = {**copies, embeddings: pair.embeddings}
    folder.mkdir()
    for part, file in copies.items():
        if file:
            shutil.copyfile(file, folder / part)
    checksums = {part: sha256(folder / part) for part, file in copies.items() if file}
    about = ModelInfo(
        sha256=checksums.pop(FILE),
        layout=CLIP,
        classes=labeller.words,
        license=license,
        source=pair.image.name,
        parts=checksums,
    )
    (folder / ABOUT).write_bytes(msgspec.json.format(msgspec.json.encode(about), indent=1))
    return about


def _fill(folder: Path, file: Path, config: NetworkConfig, license: str) -> ModelInfo:
    """Copy a detector into a new folder, check it and write its description there."""
    folder.mkdir()
    shutil.copyfile(file, folder / FILE)
    detector = OnnxDetector(folder / FILE, config, name=str(file))
    about = ModelInfo(
        sha256=sha256(folder / FILE),
        layout=detector.layout,
        classes=detector.names,
        license=license,
        source=file.name,
    )
    (folder / ABOUT).write_bytes(msgspec.json.format(msgspec.json.encode(about), indent=1))
    return about


def _require_name(name: str) -> None:
    if not NAME_PATTERN.fullmatch(name):
        raise ConfigError(
            f"{name!r} is not a valid model name: use at most 64 letters, digits, '.', '-' and "
            "'_', and begin with a letter or digit."
        )
    if name == demo_networks.NAME:
        raise ConfigError(
            f"{name!r} is reserved for the networks of the package: choose another name."
        )
