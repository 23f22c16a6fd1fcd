"""Networks that the user has registered: `ldo models`. Only `demo` comes with the package.

    <folder>/<name>/model.onnx    a copy of the file: a detector, or the image encoder of a pair
    <folder>/<name>/about.json    checksum, layout, classes, license

and of a pair that names regions (CLIP's layout) a text encoder with its byte pairs, or embeddings:

    text.onnx, bpe.txt.gz
    embeddings.npz or embeddings.safetensors

The folder is LDO_MODELS, or ldo/models where XDG_DATA_HOME says that data of programs live.
"""

import os
import re
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
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
IMAGES = (FILE, "image_encoder.onnx")  # as a folder that is not registered may name them
CLIP = "clip"  # layout of a pair


class ModelInfo(msgspec.Struct, frozen=True, kw_only=True):
    """What is known of a registered network."""

    sha256: str
    layout: str
    classes: tuple[str, ...]
    license: str = ""  # its text; empty: not stated
    source: str = ""  # name of the file it was copied from
    parts: dict[str, str] = {}  # checksums of the other files of a pair, by name


@dataclass(frozen=True, slots=True)
class Model:
    name: str
    folder: Path
    about: ModelInfo

    @property
    def file(self) -> Path:
        return self.folder / FILE

    def verify(self) -> None:
        """Raises ModelError when the file is not the one that was registered."""
        for part, registered in {FILE: self.about.sha256, **self.about.parts}.items():
            try:
                is_whole = sha256(self.folder / part) == registered
            except OSError:
                is_whole = False
            if not is_whole:
                raise ModelError(
                    f"{self.folder / part} is not what was registered as {self.name}: it is "
                    f"damaged or was replaced. `ldo models remove {self.name}` and add it again."
                )


class Models:
    """The registered networks in a folder, by default the user's."""

    def __init__(self, folder: Path | None = None) -> None:
        self.folder = folder or default_folder()

    def add(self, name: str, file: Path, config: NetworkConfig, license: str = "") -> Model:
        """Copy and register a network that is a detector, all of it or nothing.

        Raises ConfigError for a name that is taken or none, ModelError for a file that cannot be
        used.
        """
        return self._add(name, [file], lambda folder: _fill(folder, file, config, license))

    def add_pair(
        self,
        name: str,
        pair: EncoderFiles,
        config: DualEncoderConfig,
        names: Sequence[str] = (),
        license: str = "",
    ) -> Model:
        """The same for a pair of encoders, see `DualEncoder`; `names` are kept with it."""
        files = [file for file in (pair.image, pair.text, pair.vocabulary, pair.embeddings) if file]
        return self._add(
            name, files, lambda folder: _fill_pair(folder, pair, config, names, license)
        )

    def _add(self, name: str, files: Sequence[Path], fill: Callable[[Path], ModelInfo]) -> Model:
        _require_name(name)
        if (self.folder / name).exists():
            raise ConfigError(
                f"there is a model {name!r} already: `ldo models remove {name}`, or choose another "
                "name."
            )
        for file in files:
            if not file.is_file():
                raise ModelError(f"{file} is no file: name an ONNX file.")
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            with folder_made_atomically(self.folder / name) as folder:
                about = fill(folder)
        except OSError as error:
            raise ConfigError(
                f"{self.folder} cannot be written: {error}. LDO_MODELS names another folder."
            ) from error
        return Model(name, self.folder / name, about)

    def remove(self, name: str) -> None:
        """Raises ConfigError when there is none of this name."""
        self._require_known(name)
        try:
            shutil.rmtree(self.folder / name)
        except OSError as error:
            raise ConfigError(f"{self.folder / name} cannot be removed: {error}.") from error

    def get(self, name: str) -> Model:
        """Raises ConfigError when there is none of this name, ModelError when it is damaged."""
        self._require_known(name)
        folder = self.folder / name
        try:
            values = msgspec.json.decode((folder / ABOUT).read_bytes(), type=dict[str, Any])
            if "licence" in values:  # Written by version 0.1.
                values["license"] = values.pop("licence")
            about = msgspec.convert(values, ModelInfo)
        except (OSError, msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            raise ModelError(
                f"{folder / ABOUT} cannot be read ({error}): `ldo models remove {name}` and add it "
                "again."
            ) from error
        return Model(name, folder, about)

    @property
    def names(self) -> list[str]:
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
    """As the XDG base directory specification has it, unless LDO_MODELS is set."""
    if folder := os.environ.get("LDO_MODELS"):
        return Path(folder).expanduser()
    data = os.environ.get("XDG_DATA_HOME") or os.path.expanduser("~/.local/share")
    return Path(data) / "ldo" / "models"


def open_detector(model: str, config: NetworkConfig) -> OnnxDetector:
    """A detector by the name it is registered as, or by its file.

    What the configuration says of layout and names comes before what was registered.
    Raises ConfigError when there is neither, ModelError when it cannot be used.
    """
    if model == demo_networks.NAME:
        return _open_demo_detector(config)
    models = Models()
    if model not in models.names:
        path = Path(model).expanduser()
        if not path.is_file():
            raise ConfigError(
                f"detector.model={model} is neither `demo`, which comes with the package, nor an "
                f"ONNX file, nor registered in {models.folder}, where there are: "
                f"{', '.join(models.names) or 'none'}. `ldo models add NAME FILE` registers one."
            )
        return OnnxDetector(path, config)
    found = models.get(model)
    found.verify()
    if found.about.layout == CLIP:
        raise ModelError(f"{model} is a pair that names regions: vlm_labeller.model takes it.")
    settings = replace(config, layout=config.layout or found.about.layout)
    return OnnxDetector(found.file, settings, found.about.classes, name=model)


def open_labeller(model: str, config: DualEncoderConfig, names: Sequence[str] = ()) -> DualEncoder:
    """A pair by the name it is registered as, or by a folder with its files named as here.

    names  to choose from; empty: those it was registered with
    Raises ConfigError when there is neither, ModelError when it cannot be used.
    """
    if model == demo_networks.NAME:
        return _open_demo_labeller(config, names)
    models = Models()
    if model not in models.names:
        folder = Path(model).expanduser()
        if not any((folder / file).is_file() for file in IMAGES):
            raise ConfigError(
                f"vlm_labeller.model={model} is neither a folder with {' or '.join(IMAGES)} nor "
                f"registered in {models.folder}, where there are: "
                f"{', '.join(models.names) or 'none'}. "
                "`ldo models add NAME FILE --embeddings FILE` registers one."
            )
        return DualEncoder(_pair_in(folder), config, names, name=folder.name)
    found = models.get(model)
    found.verify()
    if found.about.layout != CLIP:
        raise ModelError(f"{model} is a detector, {found.about.layout}: detector.model takes it.")
    return DualEncoder(_pair_in(found.folder), config, names or found.about.classes, name=model)


def _pair_in(folder: Path) -> EncoderFiles:
    def here(*parts: str) -> Path | None:
        return next((folder / part for part in parts if (folder / part).is_file()), None)

    return EncoderFiles(
        here(*IMAGES) or folder / FILE, here(TEXT), here(VOCABULARY), here(*EMBEDDINGS)
    )


def _fill_pair(
    folder: Path, pair: EncoderFiles, config: DualEncoderConfig, names: Sequence[str], license: str
) -> ModelInfo:
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
    """A folder for the model; what is described is the copy."""
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
            f"{name!r} is no name for a model: use letters, digits, '.', '-' and '_', at most 64, "
            "beginning with a letter or digit."
        )
    if name == demo_networks.NAME:
        raise ConfigError(f"{name!r} are the networks of the package: choose another name.")


def _open_demo_detector(config: NetworkConfig) -> OnnxDetector:
    return OnnxDetector(demo_networks.DETECTOR, config, name=demo_networks.NAME)


def _open_demo_labeller(config: DualEncoderConfig, names: Sequence[str] = ()) -> DualEncoder:
    """To choose from `names`, or from all of the table, but for those of demo_networks.NOTHING.

    Raises ConfigError for a name that is not in the table: there is no text encoder.
    """
    pair = EncoderFiles(demo_networks.IMAGE_ENCODER, embeddings=demo_networks.TEXT_EMBEDDINGS)
    settings = replace(config, nothing=config.nothing or demo_networks.NOTHING)
    return DualEncoder(pair, settings, names, name=demo_networks.NAME)
