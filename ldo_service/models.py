"""Networks that the user has registered: `ldo models`. None comes with the package.

    <folder>/<name>/model.onnx    a copy of the file
    <folder>/<name>/about.json    checksum, layout, classes, licence

The folder is LDO_MODELS, or ldo/models where XDG_DATA_HOME says that data of programs live.
"""

import os
import re
import shutil
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec

from ldo_service.errors import ConfigError, ModelError
from ldo_service.semantics.detectors import NetworkConfig, OnnxDetector
from ldo_service.semantics.network import sha256

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
FILE, ABOUT = "model.onnx", "about.json"


class About(msgspec.Struct, frozen=True, kw_only=True):
    """What is known of a registered network."""

    sha256: str
    layout: str
    classes: tuple[str, ...]
    licence: str = ""  # its text; empty: not stated
    source: str = ""  # name of the file it was copied from


@dataclass(frozen=True, slots=True)
class Model:
    name: str
    folder: Path
    about: About

    @property
    def file(self) -> Path:
        return self.folder / FILE

    def verify(self) -> None:
        """Raises ModelError when the file is not the one that was registered."""
        try:
            is_whole = sha256(self.file) == self.about.sha256
        except OSError:
            is_whole = False
        if not is_whole:
            raise ModelError(
                f"{self.file} is not what was registered as {self.name}: it is damaged or was "
                f"replaced. `ldo models remove {self.name}` and add it again."
            )


class Models:
    """The registered networks in a folder, by default the user's."""

    def __init__(self, folder: Path | None = None) -> None:
        self.folder = folder or default_folder()

    def add(self, name: str, file: Path, config: NetworkConfig, licence: str = "") -> Model:
        """Copy and register a network that is a detector, all of it or nothing.

        Raises ConfigError for a name that is taken or none, ModelError for a file that cannot be
        used.
        """
        _require_name(name)
        if (self.folder / name).exists():
            raise ConfigError(
                f"there is a model {name!r} already: `ldo models remove {name}`, or choose another "
                "name."
            )
        if not file.is_file():
            raise ModelError(f"{file} is no file: name an ONNX file.")
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(prefix=".new-", dir=self.folder) as unfinished:
                about = _fill(Path(unfinished) / name, file, config, licence)
                (Path(unfinished) / name).rename(self.folder / name)
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
            about = msgspec.json.decode((folder / ABOUT).read_bytes(), type=About)
        except (OSError, msgspec.DecodeError) as error:
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
        return [entry.name for entry in entries if NAME.fullmatch(entry.name) and entry.is_dir()]

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
    models = Models()
    if model not in models.names:
        path = Path(model).expanduser()
        if not path.is_file():
            raise ConfigError(
                f"detector.model={model} is neither an ONNX file nor registered in "
                f"{models.folder}, where there are: {', '.join(models.names) or 'none'}. "
                "`ldo models add NAME FILE` registers one."
            )
        return OnnxDetector(path, config)
    found = models.get(model)
    found.verify()
    settings = replace(config, layout=config.layout or found.about.layout)
    return OnnxDetector(found.file, settings, found.about.classes, name=model)


def _fill(folder: Path, file: Path, config: NetworkConfig, licence: str) -> About:
    """A folder for the model; what is described is the copy."""
    folder.mkdir()
    shutil.copyfile(file, folder / FILE)
    detector = OnnxDetector(folder / FILE, config, name=str(file))
    about = About(
        sha256=sha256(folder / FILE),
        layout=detector.layout,
        classes=detector.names,
        licence=licence,
        source=file.name,
    )
    (folder / ABOUT).write_bytes(msgspec.json.format(msgspec.json.encode(about), indent=1))
    return about


def _require_name(name: str) -> None:
    if not NAME.fullmatch(name):
        raise ConfigError(
            f"{name!r} is no name for a model: use letters, digits, '.', '-' and '_', at most 64, "
            "beginning with a letter or digit."
        )
