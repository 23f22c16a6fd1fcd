"""Text embeddings of names, computed by a text encoder or read from a file."""

import gzip
import zlib
from collections.abc import Sequence
from itertools import chain
from pathlib import Path

import numpy as np
from safetensors import SafetensorError, safe_open
from tokenizers import Regex, Tokenizer, models, normalizers, pre_tokenizers, processors

from ldo_service.detection.onnx_network import Network
from ldo_service.detection.vocabulary import canonical, is_name, normalized
from ldo_service.errors import ModelError
from ldo_service.storage.arrays_file import UNREADABLE, read_arrays

WORD_END = "</w>"
START, END = "<|startoftext|>", "<|endoftext|>"
# Maximum merges that are read. CLIP's vocabulary has 49,408 tokens: 512 for bytes, two for start
# and end of a text, the others for merges. CLIP's file has more merges than CLIP uses.
MAX_MERGES = 49_408 - 512 - 2
MAX_VOCABULARY_BYTES = 1 << 26  # Maximum size of the unpacked file; CLIP's has 3 MB.
_WORDS = r"'(?:s|t|re|ve|m|ll|d)|\p{L}+|\p{N}|[^\s\p{L}\p{N}]+"  # Words as in CLIP.

MAX_BYTES = 1 << 30  # Maximum size of embeddings: enough for 260,000 names in 1024 dimensions.
CONTEXT = 77  # Number of tokens, as in CLIP, if a network takes any number.


def read_tokenizer(path: Path) -> Tokenizer:
    """Return a tokenizer like CLIP's with the byte pairs of a file.

    Tokens are numbered in the order of CLIP:

    1. the 256 bytes, printable ones first;
    2. the 256 bytes again, as ends of words;
    3. the merged byte pairs, in the order of the file;
    4. the tokens for start and end of a text.

    Args:
        path: A file such as CLIP's bpe_simple_vocab_16e6.txt.gz: a comment line, then one pair per
            line.

    Raises:
        ModelError: If the file cannot be read or is not a list of byte pairs.
    """
    _, *lines = _text(path).splitlines() or [""]
    merges = [tuple(line.split()) for line in lines[:MAX_MERGES] if line.strip()]
    pairs = [(pair[0], pair[1]) for pair in merges if len(pair) == 2]
    letters = sorted(pre_tokenizers.ByteLevel.alphabet())
    ends = [letter + WORD_END for letter in letters]
    symbols = [*letters, *ends, *map("".join, pairs), START, END]
    ids = {symbol: number for number, symbol in enumerate(symbols)}
    if not merges or len(pairs) < len(merges) or not ids.keys() >= {*chain.from_iterable(pairs)}:
        raise ModelError(
            f"{path} is not a list of byte pairs. Give a file with a comment line, then two "
            "symbols per line, such as CLIP's bpe_simple_vocab_16e6.txt.gz."
        )
    tokenizer = Tokenizer(models.BPE(ids, pairs, end_of_word_suffix=WORD_END))
    tokenizer.normalizer = normalizers.Lowercase()
    tokenizer.pre_tokenizer = pre_tokenizers.Sequence(
        [
            pre_tokenizers.Split(Regex(_WORDS), "removed", invert=True),
            pre_tokenizers.ByteLevel(add_prefix_space=False, use_regex=False),
        ]
    )
    tokenizer.post_processor = processors.TemplateProcessing(
        f"{START} $A {END}", special_tokens=[(START, ids[START]), (END, ids[END])]
    )
    return tokenizer


def _text(path: Path) -> str:
    """Return the text of a file, which may be compressed by gzip.

    Raises:
        ModelError: If the file cannot be read or is too large.
    """
    try:
        body = path.read_bytes()
        if body.startswith(b"\x1f\x8b"):
            with gzip.open(path) as file:
                body = file.read(MAX_VOCABULARY_BYTES + 1)
        if len(body) > MAX_VOCABULARY_BYTES:
            raise ModelError(
                f"{path} has more than {MAX_VOCABULARY_BYTES} bytes unpacked. Give a list of byte "
                "pairs such as CLIP's bpe_simple_vocab_16e6.txt.gz."
            )
        return body.decode("utf-8")
    except (OSError, EOFError, zlib.error, UnicodeDecodeError) as error:
        raise ModelError(
            f"the byte pairs in {path} cannot be read: {error}. Give a list of byte pairs such as "
            "CLIP's bpe_simple_vocab_16e6.txt.gz."
        ) from error


class TextEncoder:
    """Text encoder of names.

    The embedding of a name is the mean of the embeddings of its prompts, scaled to length 1.
    """

    def __init__(self, network: Network, tokenizer: Tokenizer, prompts: Sequence[str]) -> None:
        """Create an encoder of names, and run its network once as a check.

        Args:
            network: The network that computes the embedding of tokens.
            tokenizer: Tokenizer of the network.
            prompts: Texts with {} in place of the name.

        Raises:
            ModelError: If the network is not a text encoder.
        """
        self._network, self._tokenizer, self._prompts = network, tokenizer, tuple(prompts)
        self._inputs, context = _text_inputs(network)
        tokenizer.enable_truncation(context)  # Longer texts are cut at the end.
        tokenizer.enable_padding(length=context)
        self.dimensions = len(self._of_text("a"))

    def embed(self, name: str) -> np.ndarray:
        """Return the embedding of a name, [D] float32 of length 1."""
        rows = [unit(self._of_text(prompt.format(name))) for prompt in self._prompts]
        return unit(np.mean(rows, axis=0))

    def _of_text(self, text: str) -> np.ndarray:
        tokens = self._tokenizer.encode(text)
        inputs = {
            name: np.array([tokens.attention_mask if "mask" in name else tokens.ids], kind)
            for name, kind in self._inputs.items()
        }
        return only_embedding(self._network.run(**inputs))


class CachedEmbeddings:
    """Embeddings of names from a file.

    The file is .npz or .safetensors, with `embeddings` [C, D], `names` [C] and, optionally, the
    number `logit_scale`. A .safetensors file has the names in its metadata entry `names`, one per
    line.

    Attributes:
        names: The names.
        dimensions: Number of dimensions D.
        logit_scale: Factor on the cosines before the softmax; None if the file has none.
    """

    def __init__(self, path: Path) -> None:
        """Read a file.

        Raises:
            ModelError: If the file cannot be read or its embeddings are invalid.
        """
        try:
            names, arrays = _safetensors(path) if path.suffix == ".safetensors" else _npz(path)
            embeddings = np.asarray(arrays["embeddings"], np.float32)
        except (*UNREADABLE, SafetensorError) as error:
            raise ModelError(
                f"{path} cannot be read as embeddings ({error}). Give a file in .npz or "
                ".safetensors with `names` and `embeddings`."
            ) from error
        if embeddings.ndim != 2 or len(embeddings) != len(names) or not all(map(is_name, names)):
            raise ModelError(
                f"{path} has {len(names)} names and embeddings of shape {list(embeddings.shape)}. "
                "Write one row of embeddings per name, and names of 1 to 100 characters."
            )
        if not (np.isfinite(embeddings).all() and np.linalg.norm(embeddings, axis=1).all()):
            raise ModelError(
                f"{path} has embeddings with NaN, infinity or only zeros. Compute them again; all "
                "numbers must be finite, and each row must have a number other than 0."
            )
        self.names = names
        self.dimensions = embeddings.shape[1]
        self.logit_scale = _scale(arrays.get("logit_scale"), path)
        rows = list(zip(names, embeddings, strict=True))
        self._rows = {canonical(name): row for name, row in reversed(rows)}
        self._rows |= {normalized(name): row for name, row in rows}

    def find(self, name: str) -> np.ndarray | None:
        """Return the embedding of a name or one of its synonyms, [D] float32 of length 1.

        The result is None if the file has neither the name nor a synonym.
        """
        row = self._rows.get(normalized(name), self._rows.get(canonical(name)))
        return None if row is None else unit(row)


class TextEmbeddings:
    """Text embeddings that are read from a file, or computed if the file does not have the text."""

    def __init__(self, cached: CachedEmbeddings | None, encoder: TextEncoder | None) -> None:
        """Combine a file of embeddings and a text encoder; either may be None."""
        self.cached, self.encoder = cached, encoder

    def find(self, text: str) -> np.ndarray | None:
        """Return the embedding of a text, [D] float32 of length 1.

        The result is None if the file does not have the text and there is no text encoder.
        """
        row = self.cached.find(text) if self.cached else None
        if row is None and self.encoder is not None:
            row = self.encoder.embed(normalized(text))
        return row

    def encode(self, texts: Sequence[str]) -> np.ndarray:
        """Return the embeddings of T texts, [T, D] float32.

        The row of a text without an embedding is zero, so that its cosine with every other row
        is 0.
        """
        rows = [self.find(text) for text in texts]
        (dimensions,) = {space.dimensions for space in (self.cached, self.encoder) if space}
        nowhere = np.zeros(dimensions, np.float32)
        return np.array([nowhere if row is None else row for row in rows])


def unit(vector: np.ndarray) -> np.ndarray:
    """Return a vector [D] scaled to length 1, [D] float32.

    Raises:
        ModelError: If the vector has the length 0.
    """
    length = np.linalg.norm(vector)
    if not length > 0:
        raise ModelError(
            "the network yields an embedding of zeros, so its weights are damaged: export it again."
        )
    return (vector / length).astype(np.float32)


def only_embedding(outputs: Sequence[np.ndarray]) -> np.ndarray:
    """Return the only output of shape [1, D], as [D] float32.

    Outputs of other shapes are ignored, because exporters may add hidden states.

    Raises:
        ModelError: If there is not exactly one such output.
    """
    found = [output for output in outputs if output.ndim == 2 and len(output) == 1]
    if len(found) != 1 or found[0].shape[1] < 2:
        shapes = ", ".join(str(list(output.shape)) for output in outputs)
        raise ModelError(
            f"the network's outputs have the shapes {shapes}. Expected: exactly one output of "
            "shape [1, D], the embedding of one image or text. Export the network with this output."
        )
    return found[0][0].astype(np.float32)


def _text_inputs(network: Network) -> tuple[dict[str, type[np.integer]], int]:
    """Return the type of each input by name, and the number of tokens that the inputs take.

    Raises:
        ModelError: If the network has other inputs than tokens and an attention mask.
    """
    kinds: dict[str, type[np.integer]] = {"tensor(int64)": np.int64, "tensor(int32)": np.int32}
    inputs, shapes = network.inputs, [shape for _, _, shape in network.inputs]
    tokens = [name for name, _, _ in inputs if "mask" not in name]
    fits = all(kind in kinds and len(shape) == 2 for _, kind, shape in inputs)
    lengths = {shape[1] for shape in shapes if fits and isinstance(shape[1], int)}
    if not fits or len(tokens) != 1 or len(lengths) > 1 or min(lengths, default=CONTEXT) < 3:
        found_inputs = ", ".join(f"{name} {kind} {shape}" for name, kind, shape in inputs)
        raise ModelError(
            f"the network's inputs are {found_inputs}. Expected: tokens, int64 or int32 "
            "[1, length], and optionally an attention mask of the same shape. Export the text "
            "encoder with these inputs."
        )
    return {name: kinds[kind] for name, kind, _ in inputs}, int(min(lengths, default=CONTEXT))


def _npz(path: Path) -> tuple[tuple[str, ...], dict[str, np.ndarray]]:
    arrays = read_arrays(path, MAX_BYTES)
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
        raise ModelError(f"{path} has logit_scale={value}. Write one positive, finite number.")
    return scale
