"""ldo models"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console
from rich.table import Table

from ldo_service import demo_networks
from ldo_service.detection.detectors import NetworkConfig
from ldo_service.detection.labellers.dual_encoder import DualEncoderConfig, EncoderFiles
from ldo_service.detection.model_registry import Model, Models
from ldo_service.detection.vocabulary import read_names
from ldo_service.errors import ConfigError, LdoError, ModelError

Name = Annotated[
    str,
    tyro.conf.Positional,
    tyro.conf.arg(metavar="NAME", help="what `detector.model` or `vlm_labeller.model` calls it"),
]


@dataclass(frozen=True)
class AddModel:
    """Check a network in ONNX, copy and register it.

    ldo models add nano yolox_nano.onnx --license Apache-2.0

    With a text encoder or embeddings FILE is the image encoder of a pair in CLIP's layout, which
    names regions:

    ldo models add clip visual.onnx --text text.onnx --vocabulary bpe_simple_vocab_16e6.txt.gz
    ldo models add clip visual.onnx --embeddings names.npz
    """

    name: Name
    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE", help="in ONNX")]
    layout: Annotated[
        Literal["yolov5", "yolox", "yolov8"] | None,
        tyro.conf.arg(help="of its output; otherwise recognised"),
    ] = None
    names: Annotated[
        str,
        tyro.conf.arg(
            metavar="FILE",
            help="its classes, one a line; otherwise those it carries, or the 80 of COCO",
        ),
    ] = ""
    license: Annotated[
        str, tyro.conf.arg(metavar="FILE|TEXT", help="what you may do with it, kept beside it")
    ] = ""
    text: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help="text encoder in ONNX")] = None
    vocabulary: Annotated[
        Path | None, tyro.conf.arg(metavar="FILE", help="its byte pairs, as CLIP's .txt.gz")
    ] = None
    embeddings: Annotated[
        Path | None,
        tyro.conf.arg(
            metavar="FILE", help="names, embeddings and perhaps logit_scale, .npz or .safetensors"
        ),
    ] = None

    @property
    def is_pair(self) -> bool:
        return any((self.text, self.vocabulary, self.embeddings))

    def pair(self) -> EncoderFiles:
        """Raises ConfigError for half a pair."""
        files = self.file, self.text, self.vocabulary, self.embeddings
        image, text, vocabulary, embeddings = (file and file.expanduser() for file in files)
        assert image is not None
        return EncoderFiles(image, text, vocabulary, embeddings)


@dataclass(frozen=True)
class ListModels:
    """Show the registered networks."""


@dataclass(frozen=True)
class RemoveModel:
    """Forget a registered network and delete its copy."""

    name: Name


Verb = (
    Annotated[AddModel, tyro.conf.subcommand("add")]
    | Annotated[ListModels, tyro.conf.subcommand("list")]
    | Annotated[RemoveModel, tyro.conf.subcommand("remove")]
)


def models(verb: Verb) -> None:
    """Register, list and remove the networks that find objects, and those that name regions.

    `detector.model` in the configuration takes a registered name, and `vlm_labeller.model` that of
    a pair. Only `demo` comes with the package, a detector and a pair for the synthetic scenes:

      ldo models add nano yolox_nano.onnx
      ldo run SOURCE --out DIR --set detector.model=nano
    """
    match verb:
        case AddModel():
            add(verb)
        case ListModels():
            show(Console(highlight=False, markup=False, soft_wrap=True))
        case RemoveModel():
            Models().remove(verb.name)
            print(f"{verb.name} is removed.")


def add(verb: AddModel) -> None:
    """Raises ConfigError for what cannot be used."""
    model = _add_pair(verb) if verb.is_pair else _add_detector(verb)
    about = model.about
    print(
        f"{model.name} is registered: {about.layout}, {len(about.classes)} classes "
        f"({', '.join(about.classes[:3])}, ...), in {model.folder}."
    )


def _add_detector(verb: AddModel) -> Model:
    config = NetworkConfig(layout=verb.layout or "", names=verb.names)
    return Models().add(verb.name, verb.file.expanduser(), config, _license(verb.license))


def _add_pair(verb: AddModel) -> Model:
    if verb.layout:
        raise ConfigError(f"--layout {verb.layout} is of a detector, and a pair was named.")
    names = read_names(Path(verb.names).expanduser()) if verb.names else ()
    license = _license(verb.license)
    return Models().add_pair(verb.name, verb.pair(), DualEncoderConfig(), names, license)


def show(console: Console) -> None:
    """Raises LdoError when one of them is damaged."""
    registered, damaged = Models(), 0
    table = Table("name", "layout", "classes", "license", "sha256", "")
    for name in registered.names:
        try:
            model = registered.get(name)
            model.verify()
            about = model.about
            license = (about.license.strip().splitlines() or ["not stated"])[0]
            table.add_row(
                *(name, about.layout, str(len(about.classes)), license[:40]),
                *(about.sha256[:12], "ok"),
            )
        except ModelError:
            table.add_row(name, "", "", "", "", "damaged")
            damaged += 1
    if registered.names:
        console.print(table)
    else:
        console.print(f"none in {registered.folder}: `ldo models add NAME FILE` registers one.")
    console.print(f"{demo_networks.NAME}, a detector and a pair, comes with the package.")
    if damaged:
        raise LdoError(f"{damaged} of the above must be removed and added again.")


def _license(text: str) -> str:
    """The text of a file, or the text itself."""
    path = Path(text)
    try:
        is_file = path.is_file()
    except OSError:  # too long for the name of a file
        return text
    try:
        return path.read_text("utf-8") if is_file else text
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"--license {text} cannot be read: {error}.") from error
