"""Command `ldo models`: register, list and remove networks."""

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
from ldo_service.detection.onnx_network import Network
from ldo_service.detection.sentence_encoder import TOKENS
from ldo_service.detection.sentence_models import add_sentence_encoder
from ldo_service.detection.vocabulary import read_names
from ldo_service.errors import ConfigError, LdoError, ModelError

from .options import argument

Name = Annotated[
    str,
    tyro.conf.Positional,
    argument(metavar="NAME", help="name for `detector.model` or `vlm_labeller.model`"),
]


@dataclass(frozen=True)
class AddModel:
    """Check an ONNX network, copy it into the registry and register it under NAME.

    By default, FILE is a detector. With --text or --embeddings, FILE is the image encoder of an
    encoder pair in the layout of CLIP. An encoder pair labels regions. With --tokenizer, FILE is a
    sentence encoder, with which `ldo query` compares its text with the names of objects.

      ldo models add nano yolox_nano.onnx --license Apache-2.0
      ldo models add clip visual.onnx --text text.onnx --vocabulary bpe_simple_vocab_16e6.txt.gz
      ldo models add clip visual.onnx --embeddings names.npz
      ldo models add minilm model.onnx --tokenizer tokenizer.json
    """

    name: Name
    file: Annotated[Path, tyro.conf.Positional, argument(metavar="FILE", help="network in ONNX")]
    layout: Annotated[
        Literal["yolov5", "yolox", "yolov8"] | None,
        argument(help="layout of the network's output; default: recognized from its shape"),
    ] = None
    names: Annotated[
        str,
        argument(
            metavar="FILE",
            help="text file with the class names of the network, one per line; default: the names "
            "in the network file, or the 80 names of COCO",
        ),
    ] = ""
    license: Annotated[
        str,
        argument(metavar="FILE|TEXT", help="license of the network, stored with the network"),
    ] = ""
    text: Annotated[Path | None, argument(metavar="FILE", help="text encoder in ONNX")] = None
    vocabulary: Annotated[
        Path | None,
        argument(metavar="FILE", help="byte pairs of the text encoder, a .txt.gz file as for CLIP"),
    ] = None
    embeddings: Annotated[
        Path | None,
        argument(
            metavar="FILE",
            help="file in .npz or .safetensors with names, their embeddings and optionally "
            "logit_scale",
        ),
    ] = None
    tokenizer: Annotated[
        Path | None,
        argument(
            metavar="FILE",
            help="tokenizer.json or vocab.txt of a sentence encoder",
        ),
    ] = None

    @property
    def is_pair(self) -> bool:
        return any((self.text, self.vocabulary, self.embeddings))

    def pair(self) -> EncoderFiles:
        """Return the files of the encoder pair.

        Raises:
            ConfigError: Files of the pair are missing.
        """
        files = self.file, self.text, self.vocabulary, self.embeddings
        image, text, vocabulary, embeddings = (file and file.expanduser() for file in files)
        assert image is not None
        return EncoderFiles(image, text, vocabulary, embeddings)


@dataclass(frozen=True)
class ListModels:
    """Show the registered networks."""


@dataclass(frozen=True)
class RemoveModel:
    """Unregister a network and delete its copy."""

    name: Name


Verb = (
    Annotated[AddModel, tyro.conf.subcommand("add")]
    | Annotated[ListModels, tyro.conf.subcommand("list")]
    | Annotated[RemoveModel, tyro.conf.subcommand("remove")]
)


def models(verb: Verb) -> None:
    """Register, list and remove detectors, encoder pairs and sentence encoders.

    `detector.model` in the configuration takes the registered name of a detector.
    `vlm_labeller.model` takes the registered name of an encoder pair, which labels regions.
    `ldo query` uses a sentence encoder. The package contains only `demo`: a detector and a pair for
    the synthetic scenes.

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
    """Register a network, and print its layout and classes.

    Raises:
        ConfigError: A file cannot be used.
    """
    if verb.tokenizer:
        model = _add_sentence_encoder(verb, verb.tokenizer)
        print(f"{model.name} is registered: {model.summary}, in {model.folder}.")
        return
    model = _add_pair(verb) if verb.is_pair else _add_detector(verb)
    about = model.about
    print(
        f"{model.name} is registered: {about.layout}, {len(about.classes)} classes "
        f"({', '.join(about.classes[:3])}, ...), in {model.folder}."
    )


def _add_sentence_encoder(verb: AddModel, tokenizer: Path) -> Model:
    if verb.is_pair or verb.layout or verb.names:
        raise ConfigError(
            "--tokenizer applies to a sentence encoder, which takes no --layout, --names, --text, "
            "--vocabulary and --embeddings. Remove these options or --tokenizer."
        )
    files = verb.file.expanduser(), tokenizer.expanduser()
    return add_sentence_encoder(Models(), verb.name, *files, _license(verb.license))


def _add_detector(verb: AddModel) -> Model:
    file = verb.file.expanduser()
    config = NetworkConfig(layout=verb.layout or "", names=verb.names)
    try:
        return Models().add(verb.name, file, config, _license(verb.license))
    except ModelError as error:
        if _takes_tokens(file):
            raise ConfigError(
                f"{file} is a network for texts. Give the tokenizer.json or vocab.txt of a "
                "sentence encoder with `--tokenizer FILE`."
            ) from error
        raise


def _takes_tokens(file: Path) -> bool:
    """Return whether a file is a network whose inputs are tokens of texts."""
    try:
        return any(name == TOKENS for name, *_ in Network(file).inputs)
    except ModelError:
        return False


def _add_pair(verb: AddModel) -> Model:
    if verb.layout:
        raise ConfigError(
            f"--layout {verb.layout} applies to a detector, not to an encoder pair. Remove it."
        )
    names = read_names(Path(verb.names).expanduser()) if verb.names else ()
    license = _license(verb.license)
    return Models().add_pair(verb.name, verb.pair(), DualEncoderConfig(), names, license)


def show(console: Console) -> None:
    """Print a table of the registered networks.

    Raises:
        LdoError: A network is damaged.
    """
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
        console.print(
            f"no networks in {registered.folder}: `ldo models add NAME FILE` registers one."
        )
    console.print(f"{demo_networks.NAME}, a detector and a pair, comes with the package.")
    if damaged:
        raise LdoError(
            f"damaged networks in the table: {damaged}. Remove each with `ldo models remove NAME`, "
            "and add it again with `ldo models add`."
        )


def _license(text: str) -> str:
    """Return the content of the file named `text`, or `text` itself if there is no such file."""
    path = Path(text)
    try:
        is_file = path.is_file()
    except OSError:  # The text is too long for a file name.
        return text
    try:
        return path.read_text("utf-8") if is_file else text
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(
            f"--license {text} cannot be read: {error}. Give a text file in UTF-8."
        ) from error
