"""Labels by an image encoder and a text encoder with a common embedding space, as in CLIP.

CLIP is the network of Radford et al., ICML 2021.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ldo_service.detection.labellers import ScoredLabel, fused_over_views
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

# Normalization of RGB in 0..1, from the code of Radford et al.
CLIP_MEAN = (0.48145466, 0.4578275, 0.40821073)
CLIP_STD = (0.26862954, 0.26130258, 0.27577711)
CLIP_SCALE = 100.0  # CLIP's logit scale after training, which is also the maximum in training.
CLIP_PX = 224  # Side of the input if an image encoder takes any size.
MAX_LABELS = 5  # Maximum labels of a region; less probable ones are noise.


@dataclass(frozen=True, slots=True)
class DualEncoderConfig:
    """Settings of a labeller that consists of an image encoder and a text encoder."""

    # Texts for a name, with {} in place of the name; the mean of their embeddings is used.
    prompts: tuple[str, ...] = (
        "a photo of a {}.",
        "a cropped photo of a {}.",
        "a {} in a room.",
    )
    # Mean and standard deviation of RGB in 0..1, to normalize images; empty: the values in the
    # metadata of the image encoder, or CLIP's values.
    mean: tuple[float, ...] = ()
    std: tuple[float, ...] = ()
    # Factor on the cosines before the softmax; 0: the factor in the files of the pair, or CLIP's
    # 100.
    logit_scale: float = 0.0
    # Names of what is no object, such as wall and floor. Each has a probability like all other
    # names, and a region for which one of them is the most probable gets no label.
    nothing: tuple[str, ...] = ()
    device: str = "cpu"  # Setting `service.device`.
    threads: int = 1  # Threads of one inference; with 1, a replay is bitwise equal.

    def __post_init__(self) -> None:
        if not self.prompts or any(not _is_prompt(prompt) for prompt in self.prompts):
            raise ConfigError(
                f"dual_encoder.prompts={list(self.prompts)}: there must be at least one prompt, "
                "and each must contain {} exactly once, in place of the name, and no other braces."
            )
        are_three = len(self.mean) in (0, 3) and len(self.std) in (0, 3)
        if not are_three or min(self.std, default=1) <= 0:
            raise ConfigError(
                f"dual_encoder: mean={self.mean} and std={self.std} must each be empty or have "
                "three numbers, and every number of std must be positive."
            )
        if not 0 <= self.logit_scale < float("inf") or self.threads < 1:
            raise ConfigError(
                f"dual_encoder: logit_scale={self.logit_scale:g} must be finite and at least 0, "
                f"and threads={self.threads} must be at least 1."
            )


@dataclass(frozen=True, slots=True)
class EncoderFiles:
    """Files of a pair of encoders.

    The text encoder and its vocabulary are given together. Without them, embeddings of
    the names are required.
    """

    image: Path  # Image encoder, ONNX.
    text: Path | None = None  # Text encoder, ONNX.
    vocabulary: Path | None = None  # Byte pairs of the text encoder's tokenizer.
    embeddings: Path | None = None  # Precomputed text embeddings of names.

    def __post_init__(self) -> None:
        if (self.text is None) != (self.vocabulary is None):
            raise ConfigError(
                "a text encoder needs its byte pairs, and byte pairs need a text encoder: give "
                "both --text and --vocabulary (for CLIP, bpe_simple_vocab_16e6.txt.gz)."
            )
        if self.text is None and self.embeddings is None:
            raise ConfigError(
                f"the image encoder {self.image} needs text embeddings: give a text encoder "
                "(--text and --vocabulary) or a file of embeddings (--embeddings)."
            )


class DualEncoder:
    """Labeller by an image encoder and a text encoder with a common embedding space."""

    def __init__(
        self,
        pair: EncoderFiles,
        config: DualEncoderConfig | None = None,
        names: Sequence[str] = (),
        name: str = "",
    ) -> None:
        """Open a pair; run the image encoder once on noise and the text encoder once on a word.

        Args:
            pair: Files of the pair.
            config: Settings.
            names: Names to choose from; empty: the names in the file of embeddings or, without such
                a file, the 80 names of COCO.
            name: Name of the pair in errors and `identity`; empty: the name of the image encoder's
                file.

        Raises:
            ConfigError: If a setting is invalid.
            ModelError: If the files are not a pair of encoders.
        """
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
                    f"{what} cannot be used as a labeller: its image embeddings have "
                    f"{self._image.dimensions} dimensions and its text embeddings "
                    f"{space.dimensions}. Use the encoders of one pair."
                )
        self.logit_scale = self._logit_scale()
        self.identity = f"{name or pair.image.stem} {sha256(pair.image)[:12]}"
        self._rows: dict[str, np.ndarray] = {}  # Text embeddings by canonical name.
        # Names to choose from and names in `nothing`, by canonical name. Of several spellings of a
        # name, the value is the first one. The text encoder gets this spelling.
        self._listed: dict[str, str] = {}
        for entry in (*(names or self._own_names()), *self.config.nothing):
            self._listed.setdefault(canonical(entry), entry)
        if self.texts.encoder is None:
            self._place_listed()

    @property
    def names(self) -> tuple[str, ...]:
        """Canonical names that the labeller returns; those in `config.nothing` are excluded."""
        nothing = set(map(canonical, self.config.nothing))
        return tuple(name for name in self._listed if name not in nothing)

    @property
    def words(self) -> tuple[str, ...]:
        """Names that `label` compares with a crop, as spelled for the text encoder.

        They include the names in `config.nothing`, such as wall and floor.
        """
        return tuple(self._listed.values())

    def label(self, crops: Sequence[np.ndarray]) -> list[ScoredLabel]:
        """Return at most five labels of a region with their probabilities, the most probable first.

            P(name) = softmax(logit_scale cos(image, name)), averaged over the crops

        For example, two names have the cosines 0.3 and 0.28, and logit_scale is 100. Then the first
        name has P = exp(30) / (exp(30) + exp(28)) = 0.881.

        Args:
            crops: Views of the region, each [h, w, 3] uint8 RGB.

        Returns:
            The labels; empty if the most probable name is in `config.nothing`.
        """
        self._place_listed()
        rows, known_names = np.stack([self._rows[name] for name in self._listed]), set(self.names)
        best = fused_over_views(self._view(crop, rows) for crop in crops)
        if not best or best[0][0] not in known_names:
            return []
        return [scored for scored in best if scored[0] in known_names][:MAX_LABELS]

    def add(self, name: str) -> None:
        """Add a name to the list that the labeller chooses from.

        Raises:
            ConfigError: If the name is invalid, or has no stored embedding and there is no text
                encoder to compute one.
        """
        if not is_name(name):
            raise ConfigError(
                f"{name[:40]!r} is not a name: write a name of 1 to {LONGEST} characters."
            )
        if canonical(name) not in self._listed:
            self._rows[canonical(name)] = self._place(name)
            self._listed[canonical(name)] = name

    def metrics(self) -> dict[str, float]:
        return {"names": len(self.names), **self._image.metrics()}

    def _view(self, crop: np.ndarray, rows: np.ndarray) -> list[ScoredLabel]:
        """Return the probability of each name for one crop, given the embeddings of all names."""
        probabilities = softmax(self.logit_scale * (rows @ self._image.embed(crop)))
        return list(zip(self._listed, probabilities.tolist(), strict=True))

    def _place_listed(self) -> None:
        """Compute the missing text embeddings of the names.

        If there is a text encoder, this method is called at the first label request and not at the
        start, because eighty names take seconds.
        """
        for name, word in self._listed.items():
            if name not in self._rows:
                self._rows[name] = self._place(word)

    def _place(self, name: str) -> np.ndarray:
        """Return the text embedding of a name, [D] float32 of length 1.

        Raises:
            ConfigError: If the name has no stored embedding and there is no text encoder.
        """
        row = self.texts.find(name)
        if row is not None:
            return row
        raise ConfigError(
            f"{name!r} has no stored embedding in {self.identity}, and there is no text encoder to "
            "compute one. Remove this encoder pair with `ldo models remove`. Then run "
            "`ldo models add` with --text (text encoder) and --vocabulary (byte pairs of the text "
            "encoder)."
        )

    def _own_names(self) -> tuple[str, ...]:
        return self.texts.cached.names if self.texts.cached else COCO

    def _logit_scale(self) -> float:
        """Return the first known logit scale: of settings, embeddings, image encoder, or CLIP."""
        stored_scale = self._image.metadata_numbers("logit_scale", 1)
        cached = self.texts.cached.logit_scale if self.texts.cached else None
        return (
            self.config.logit_scale or cached or (stored_scale[0] if stored_scale else CLIP_SCALE)
        )


class ImageEncoder:
    """Network that computes an embedding [1, D] of an image [1, 3, S, S]."""

    def __init__(self, path: Path, config: DualEncoderConfig) -> None:
        self._network = Network(path, config.device, config.threads)
        self._input, self.side_px = _square_input(self._network)
        mean = config.mean or self.metadata_numbers("mean", 3) or CLIP_MEAN
        std = config.std or self.metadata_numbers("std", 3) or CLIP_STD
        self._mean, self._std = np.array(mean, np.float32), np.array(std, np.float32)
        self._around = (255 * self._mean).clip(0, 255).round()
        noise = np.random.default_rng(0).integers(0, 256, (self.side_px, self.side_px, 3))
        self.dimensions = len(self.embed(noise.astype(np.uint8)))

    def embed(self, crop: np.ndarray) -> np.ndarray:
        """Return the embedding of a crop [h, w, 3] uint8 RGB, [D] float32 of length 1.

        The crop is padded to a square with the mean color.
        """
        pixels = _square(crop, self.side_px, self._around).astype(np.float32) / np.float32(255)
        planes = ((pixels - self._mean) / self._std).transpose(2, 0, 1)[None]
        return unit(
            only_embedding(self._network.run(**{self._input: np.ascontiguousarray(planes)}))
        )

    def metrics(self) -> dict[str, float]:
        """Return the metrics of the network, see `Network.metrics`."""
        return self._network.metrics()

    def metadata_numbers(self, key: str, count: int) -> tuple[float, ...]:
        """Return the `count` numbers of a metadata entry; empty if the network has no such entry.

        The text of the entry is like "0.5, 0.5, 0.5" or "[0.5, 0.5, 0.5]".

        Raises:
            ModelError: If the entry does not have `count` valid numbers.
        """
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
            raise ModelError(
                f"the network's metadata has {key}={text[:60]!r}. Expected: {count} finite "
                "numbers; only numbers of `mean` may be 0 or negative. Export the network again "
                "with a valid entry."
            )
        return values


def _text_encoder(pair: EncoderFiles, config: DualEncoderConfig) -> TextEncoder | None:
    if pair.text is None or pair.vocabulary is None:
        return None
    network = Network(pair.text, config.device, config.threads)
    return TextEncoder(network, read_tokenizer(pair.vocabulary), config.prompts)


def _square_input(network: Network) -> tuple[str, int]:
    """Return the name of the network's only input, and the side of its square images in pixels.

    Raises:
        ModelError: If the network has other inputs than one square image.
    """
    inputs = network.inputs
    name, kind, shape = inputs[0] if len(inputs) == 1 else ("", "", [])
    fits = len(shape) == 4 and _allows(shape[0], 1) and _allows(shape[1], 3)
    sides = {side for side in shape[2:] if isinstance(side, int)}
    if kind != "tensor(float)" or not fits or len(sides) > 1:
        found_inputs = ", ".join(f"{name} {kind} {shape}" for name, kind, shape in inputs)
        raise ModelError(
            f"the network's inputs are {found_inputs}. Expected: one image, float32 [1, 3, S, S], "
            "with equal sides S. Export the image encoder with an image as its only input."
        )
    return name, next(iter(sides), CLIP_PX)


def _allows(side: int | str | None, length: int) -> bool:
    return not isinstance(side, int) or side == length


def _square(crop: np.ndarray, side_px: int, around: np.ndarray) -> np.ndarray:
    """Scale a crop to fit into a square, centered on a background of the color `around`.

    The crop is not cut, so that the square contains the edges of the region.

    Returns:
        The square, [side_px, side_px, 3] uint8.
    """
    height, width = crop.shape[:2]
    longest = max(height, width)
    canvas = np.empty((longest, longest, 3), np.uint8)
    canvas[:] = around
    top, left = (longest - height) // 2, (longest - width) // 2
    canvas[top : top + height, left : left + width] = crop
    way = cv2.INTER_AREA if longest > side_px else cv2.INTER_CUBIC
    return cv2.resize(canvas, (side_px, side_px), interpolation=way)


def softmax(logits: np.ndarray) -> np.ndarray:
    """Return the softmax of logits [C], [C] float64.

    >>> softmax(100 * np.array([0.3, 0.28])).round(3).tolist()
    [0.881, 0.119]
    """
    powers = np.exp((logits - logits.max()).astype(np.float64))
    return powers / powers.sum()


def _is_prompt(prompt: str) -> bool:
    return prompt.count("{}") == 1 and prompt.count("{") == prompt.count("}") == 1
