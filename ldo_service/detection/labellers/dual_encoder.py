"""Names by an image encoder and a text encoder that share a space (Radford et al., ICML 2021)."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ldo_service.detection.labellers import Opinion, fused_over_views
from ldo_service.detection.onnx_network import Network, sha256
from ldo_service.detection.vocabulary import COCO, LONGEST, canonical, is_name
from ldo_service.errors import ConfigError, ModelError

from .text_embeddings import (
    CachedEmbeddings,
    TextEmbeddings,
    TextEncoder,
    only_embedding,
    read_tokenizer,
    unit,
)

CLIP_MEAN = (0.48145466, 0.4578275, 0.40821073)  # of RGB in 0..1; Radford et al., their code
CLIP_STD = (0.26862954, 0.26130258, 0.27577711)
CLIP_SCALE = 100.0  # what CLIP's logit scale is clipped to, and ends at
CLIP_PX = 224  # for an encoder that takes any size
MAX_LABELS = 5  # opinions; the others are noise


@dataclass(frozen=True, slots=True)
class DualEncoderConfig:
    """How a pair of encoders is read and run."""

    prompts: tuple[str, ...] = (  # their embeddings are averaged
        "a photo of a {}.",
        "a cropped photo of a {}.",
        "a {} in a room.",
    )
    mean: tuple[float, ...] = ()  # of RGB in 0..1; empty: what the image encoder carries, or CLIP's
    std: tuple[float, ...] = ()
    logit_scale: float = 0.0  # sharpness of the softmax; 0: what comes with the pair, or CLIP's 100
    nothing: tuple[str, ...] = ()  # names that compete and are never told, such as wall and floor
    providers: tuple[str, ...] = ("cpu",)  # of onnxruntime, by preference: cuda, tensorrt, ...
    threads: int = 1  # of one inference; with 1 a replay gives the same bits

    def __post_init__(self) -> None:
        if not self.prompts or any(not _is_prompt(prompt) for prompt in self.prompts):
            raise ConfigError(
                f"dual_encoder.prompts {list(self.prompts)}: each needs one {{}} for the name."
            )
        are_three = len(self.mean) in (0, 3) and len(self.std) in (0, 3)
        if not are_three or min(self.std, default=1) <= 0:
            raise ConfigError("dual_encoder: mean and std are three numbers, std positive.")
        if not 0 <= self.logit_scale < float("inf") or self.threads < 1:
            raise ConfigError(
                "dual_encoder: logit_scale must be positive or 0, threads at least 1."
            )


@dataclass(frozen=True, slots=True)
class EncoderFiles:
    """Files of a pair: an image encoder, and where texts lie: a text encoder with its byte pairs,
    or embeddings."""

    image: Path
    text: Path | None = None
    vocabulary: Path | None = None
    embeddings: Path | None = None

    def __post_init__(self) -> None:
        if (self.text is None) != (self.vocabulary is None):
            raise ConfigError(
                "a text encoder needs its byte pairs and they need it: name both, --text and "
                "--vocabulary (CLIP's is bpe_simple_vocab_16e6.txt.gz)."
            )
        if self.text is None and self.embeddings is None:
            raise ConfigError(
                f"{self.image} knows no text: name a text encoder (--text and --vocabulary) or "
                "embeddings of names (--embeddings)."
            )


class DualEncoder:
    """A pair that is known to fit: opening it runs both once, on noise and on a word.

    pair    its files
    config  see there
    names   to choose from; empty: those that come with embeddings, or the 80 of COCO
    name    what errors and `identity` call it; empty: the image encoder's file

    Raises ConfigError for settings that cannot be, ModelError for files that are no such networks.
    """

    def __init__(
        self,
        pair: EncoderFiles,
        config: DualEncoderConfig | None = None,
        names: Sequence[str] = (),
        name: str = "",
    ) -> None:
        self.config = config or DualEncoderConfig()
        what = name or str(pair.image)
        try:
            self._image = ImageEncoder(pair.image, self.config)
            cached = CachedEmbeddings(pair.embeddings) if pair.embeddings else None
            self.texts = TextEmbeddings(cached, _text_encoder(pair, self.config))
        except ModelError as error:
            raise ModelError(f"{what} cannot be used as a labeller: {error}") from error
        for space in (self.texts.encoder, self.texts.cached):
            if space and space.dimensions != self._image.dimensions:
                raise ModelError(
                    f"{what} cannot be used as a labeller: its images have "
                    f"{self._image.dimensions} dimensions and its texts {space.dimensions}: they "
                    "are not of one pair."
                )
        self.logit_scale = self._logit_scale()
        self.identity = f"{name or pair.image.stem} {sha256(pair.image)[:12]}"
        self._rows: dict[str, np.ndarray] = {}  # by name as a vocabulary has it
        self._listed: dict[str, str] = {}  # the same, and the word that it was first given in
        for entry in (*(names or self._own_names()), *self.config.nothing):
            self._listed.setdefault(canonical(entry), entry)
        if self.texts.encoder is None:
            self._place_listed()

    @property
    def names(self) -> tuple[str, ...]:
        nothing = set(map(canonical, self.config.nothing))
        return tuple(name for name in self._listed if name not in nothing)

    @property
    def words(self) -> tuple[str, ...]:
        """The names as they were given, which is how a text encoder is asked for them."""
        return tuple(self._listed.values())

    def label(self, crops: Sequence[np.ndarray]) -> list[Opinion]:
        """P(name) = softmax(logit_scale cos(image, name)) over the names, averaged over the crops.

        Two names, cosines 0.3 and 0.28, scale 100: exp(30) / (exp(30) + exp(28)) = 0.881.
        Empty when one of `nothing` is the most probable.
        """
        self._place_listed()
        rows, told = np.stack([self._rows[name] for name in self._listed]), set(self.names)
        best = fused_over_views(self._view(crop, rows) for crop in crops)
        if not best or best[0][0] not in told:
            return []
        return [opinion for opinion in best if opinion[0] in told][:MAX_LABELS]

    def add(self, name: str) -> None:
        """Raises ConfigError for what is no name, or when there is nothing to place it with."""
        if not is_name(name):
            raise ConfigError(f"{name[:40]!r} is no name: write one of 1 to {LONGEST} characters.")
        if canonical(name) not in self._listed:
            self._rows[canonical(name)] = self._place(name)
            self._listed[canonical(name)] = name

    def metrics(self) -> dict[str, float]:
        return {"names": len(self.names)}

    def _view(self, crop: np.ndarray, rows: np.ndarray) -> list[Opinion]:
        probabilities = softmax(self.logit_scale * (rows @ self._image.embed(crop)))
        return list(zip(self._listed, probabilities.tolist(), strict=True))

    def _place_listed(self) -> None:
        """Before they are first needed: a text encoder takes seconds for eighty names."""
        for name, word in self._listed.items():
            if name not in self._rows:
                self._rows[name] = self._place(word)

    def _place(self, name: str) -> np.ndarray:
        """[D] float32 of length 1, from the file where it is there."""
        row = self.texts.find(name)
        if row is not None:
            return row
        raise ConfigError(
            f"{name!r} is not among the names whose embeddings {self.identity} has, and there is "
            "no text encoder to place it: register the pair with --text and --vocabulary."
        )

    def _own_names(self) -> tuple[str, ...]:
        return self.texts.cached.names if self.texts.cached else COCO

    def _logit_scale(self) -> float:
        carried = self._image.metadata_numbers("logit_scale", 1)
        cached = self.texts.cached.logit_scale if self.texts.cached else None
        return self.config.logit_scale or cached or (carried[0] if carried else CLIP_SCALE)


class ImageEncoder:
    """A network that makes [1, D] of an image [1, 3, S, S]. Raises ModelError for another."""

    def __init__(self, path: Path, config: DualEncoderConfig) -> None:
        self._network = Network(path, config.providers, config.threads)
        self._input, self.side_px = _square_input(self._network)
        mean = config.mean or self.metadata_numbers("mean", 3) or CLIP_MEAN
        std = config.std or self.metadata_numbers("std", 3) or CLIP_STD
        self._mean, self._std = np.array(mean, np.float32), np.array(std, np.float32)
        self._around = (255 * self._mean).clip(0, 255).round()
        noise = np.random.default_rng(0).integers(0, 256, (self.side_px, self.side_px, 3))
        self.dimensions = len(self.embed(noise.astype(np.uint8)))

    def embed(self, crop: np.ndarray) -> np.ndarray:
        """[D] float32 of length 1, of a crop [h, w, 3] uint8 RGB, in a square of the mean."""
        pixels = _square(crop, self.side_px, self._around).astype(np.float32) / np.float32(255)
        planes = ((pixels - self._mean) / self._std).transpose(2, 0, 1)[None]
        return unit(
            only_embedding(self._network.run(**{self._input: np.ascontiguousarray(planes)}))
        )

    def metadata_numbers(self, key: str, count: int) -> tuple[float, ...]:
        """What its exporter wrote, as in "0.5, 0.5, 0.5" or "[0.5, 0.5, 0.5]"; empty: nothing."""
        text = self._network.metadata.get(key)
        if text is None:
            return ()
        try:
            numbers = json.loads(text if text.lstrip().startswith("[") else f"[{text}]")
            values = tuple(float(number) for number in numbers)
        except (ValueError, TypeError):
            values = ()
        is_usable = len(values) == count and np.isfinite(values).all()
        if not is_usable or (key != "mean" and min(values) <= 0):
            raise ModelError(f"its metadata has {key}={text[:60]!r}: {count} numbers are expected.")
        return values


def _text_encoder(pair: EncoderFiles, config: DualEncoderConfig) -> TextEncoder | None:
    if pair.text is None or pair.vocabulary is None:
        return None
    network = Network(pair.text, config.providers, config.threads)
    return TextEncoder(network, read_tokenizer(pair.vocabulary), config.prompts)


def _square_input(network: Network) -> tuple[str, int]:
    inputs = network.inputs
    name, kind, shape = inputs[0] if len(inputs) == 1 else ("", "", [])
    fits = len(shape) == 4 and _allows(shape[0], 1) and _allows(shape[1], 3)
    sides = {side for side in shape[2:] if isinstance(side, int)}
    if kind != "tensor(float)" or not fits or len(sides) > 1:
        told = ", ".join(f"{name} {kind} {shape}" for name, kind, shape in inputs)
        raise ModelError(f"its inputs are {told}. Expected: one image, float32 [N, 3, S, S].")
    return name, next(iter(sides), CLIP_PX)


def _allows(side: int | str | None, length: int) -> bool:
    return not isinstance(side, int) or side == length


def _square(crop: np.ndarray, side_px: int, around: np.ndarray) -> np.ndarray:
    """All of it, in proportion, in the middle: a region's edge must not be cut off."""
    height, width = crop.shape[:2]
    longest = max(height, width)
    canvas = np.empty((longest, longest, 3), np.uint8)
    canvas[:] = around
    top, left = (longest - height) // 2, (longest - width) // 2
    canvas[top : top + height, left : left + width] = crop
    way = cv2.INTER_AREA if longest > side_px else cv2.INTER_CUBIC
    return cv2.resize(canvas, (side_px, side_px), interpolation=way)


def softmax(logits: np.ndarray) -> np.ndarray:
    """
    >>> softmax(100 * np.array([0.3, 0.28])).round(3).tolist()
    [0.881, 0.119]
    """
    powers = np.exp((logits - logits.max()).astype(np.float64))
    return powers / powers.sum()


def _is_prompt(prompt: str) -> bool:
    return prompt.count("{}") == 1 and prompt.count("{") == prompt.count("}") == 1
