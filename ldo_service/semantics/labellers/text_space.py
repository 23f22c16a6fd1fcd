"""Where names lie in the space that images and texts share: computed, or read from a file."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from safetensors import SafetensorError, safe_open

from ldo_service.errors import ModelError
from ldo_service.semantics.class_names import is_name, normalised
from ldo_service.semantics.network import Network
from ldo_service.semantics.synonyms import canonical
from ldo_service.storage.arrays_file import UNREADABLE, read_arrays

from .byte_pairs import BytePairs

LARGEST_BYTES = 1 << 30  # of 260,000 names in 1024 dimensions
CONTEXT = 77  # tokens of a text, where a network takes any number: CLIP's


class TextEncoder:
    """Places any name: the mean of what a network makes of each prompt, brought to length 1.

    Raises ModelError for a file that is no text encoder.
    """

    def __init__(self, network: Network, pairs: BytePairs, prompts: Sequence[str]) -> None:
        self._network, self._pairs, self._prompts = network, pairs, tuple(prompts)
        self._inputs, self._context = _text_inputs(network)
        self.dimensions = len(self._of_text("a"))

    def embed(self, name: str) -> np.ndarray:
        rows = [unit(self._of_text(prompt.format(name))) for prompt in self._prompts]
        return unit(np.mean(rows, axis=0))

    def _of_text(self, text: str) -> np.ndarray:
        tokens = self._pairs.encode(text, self._context)
        mask = np.arange(self._context) <= np.flatnonzero(tokens == self._pairs.end)[0]
        values = {name: (mask if "mask" in name else tokens) for name in self._inputs}
        inputs = {name: values[name].astype(kind)[None] for name, kind in self._inputs.items()}
        return only_embedding(self._network.run(**inputs))


class CachedEmbeddings:
    """Places the names in a file, .npz or .safetensors: `embeddings` [C, D], `names` [C], and
    perhaps `logit_scale`.

    Names in .safetensors are its metadata entry `names`, a name a line. Raises ModelError.
    """

    def __init__(self, path: Path) -> None:
        try:
            names, arrays = _safetensors(path) if path.suffix == ".safetensors" else _npz(path)
            embeddings = np.asarray(arrays["embeddings"], np.float32)
        except (*UNREADABLE, SafetensorError) as error:
            raise ModelError(
                f"{path} holds no embeddings ({error}): `names` and `embeddings` are expected, "
                ".npz or .safetensors."
            ) from error
        if embeddings.ndim != 2 or len(embeddings) != len(names) or not all(map(is_name, names)):
            raise ModelError(
                f"{path} has {len(names)} names and embeddings {list(embeddings.shape)}: a row for "
                "each name is expected."
            )
        if not (np.isfinite(embeddings).all() and np.linalg.norm(embeddings, axis=1).all()):
            raise ModelError(f"{path} has embeddings that are zero, NaN or infinite.")
        self.names = names
        self.dimensions = embeddings.shape[1]
        self.logit_scale = _scale(arrays.get("logit_scale"), path)
        rows = list(zip(names, embeddings, strict=True))
        self._rows = {canonical(name): row for name, row in reversed(rows)}
        self._rows |= {normalised(name): row for name, row in rows}

    def find(self, name: str) -> np.ndarray | None:
        """[D] float32 of length 1, of this word or one that means the same; None when there is
        none in the file."""
        row = self._rows.get(normalised(name), self._rows.get(canonical(name)))
        return None if row is None else unit(row)


class Texts:
    """The text half of a pair: what is in the file is read, anything else is computed."""

    def __init__(self, cached: CachedEmbeddings | None, encoder: TextEncoder | None) -> None:
        self.cached, self.encoder = cached, encoder

    def find(self, text: str) -> np.ndarray | None:
        """[D] float32 of length 1; None where it is not in the file and there is no encoder."""
        row = self.cached.find(text) if self.cached else None
        if row is None and self.encoder is not None:
            row = self.encoder.embed(normalised(text))
        return row

    def encode(self, texts: Sequence[str]) -> np.ndarray:
        """[T, D]; zeros, which are like nothing, where `find` finds nothing."""
        rows = [self.find(text) for text in texts]
        (dimensions,) = {space.dimensions for space in (self.cached, self.encoder) if space}
        nowhere = np.zeros(dimensions, np.float32)
        return np.array([nowhere if row is None else row for row in rows])


def unit(vector: np.ndarray) -> np.ndarray:
    """Raises ModelError for one of no length."""
    length = np.linalg.norm(vector)
    if not length > 0:
        raise ModelError("it yields an embedding of zeros: its weights are damaged.")
    return (vector / length).astype(np.float32)


def only_embedding(outputs: Sequence[np.ndarray]) -> np.ndarray:
    """[D] of the one output that is [1, D]; exporters add hidden states. Raises ModelError."""
    found = [output for output in outputs if output.ndim == 2 and len(output) == 1]
    if len(found) != 1 or found[0].shape[1] < 2:
        shapes = ", ".join(str(list(output.shape)) for output in outputs)
        raise ModelError(f"its outputs are {shapes}. Expected: one embedding, [N, D].")
    return found[0][0].astype(np.float32)


def _text_inputs(network: Network) -> tuple[dict[str, type[np.integer]], int]:
    """Type of each input by name, and how many tokens they take."""
    kinds: dict[str, type[np.integer]] = {"tensor(int64)": np.int64, "tensor(int32)": np.int32}
    inputs, shapes = network.inputs, [shape for _, _, shape in network.inputs]
    tokens = [name for name, _, _ in inputs if "mask" not in name]
    fits = all(kind in kinds and len(shape) == 2 for _, kind, shape in inputs)
    lengths = {shape[1] for shape in shapes if fits and isinstance(shape[1], int)}
    if not fits or len(tokens) != 1 or len(lengths) > 1 or min(lengths, default=CONTEXT) < 3:
        told = ", ".join(f"{name} {kind} {shape}" for name, kind, shape in inputs)
        raise ModelError(f"its inputs are {told}. Expected: tokens, int64 or int32 [N, length].")
    return {name: kinds[kind] for name, kind, _ in inputs}, int(min(lengths, default=CONTEXT))


def _npz(path: Path) -> tuple[tuple[str, ...], dict[str, np.ndarray]]:
    arrays = read_arrays(path, LARGEST_BYTES)
    return tuple(map(str, arrays.pop("names").tolist())), arrays


def _safetensors(path: Path) -> tuple[tuple[str, ...], dict[str, np.ndarray]]:
    with safe_open(path, "numpy") as file:
        arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        return tuple((file.metadata() or {})["names"].splitlines()), arrays


def _scale(value: np.ndarray | None, path: Path) -> float | None:
    if value is None:
        return None
    scale = float(np.asarray(value).reshape(-1)[0]) if np.size(value) == 1 else float("nan")
    if not 0 < scale < float("inf"):
        raise ModelError(f"{path} has logit_scale {value}: one positive number is expected.")
    return scale
