"""Sentence encoder: a network that maps texts of similar meaning to similar vectors.

The network is a transformer in ONNX with the inputs and outputs of sentence-transformers (Reimers
and Gurevych, EMNLP 2019).
"""

from collections.abc import Sequence
from itertools import count
from pathlib import Path

import numpy as np
from tokenizers import Tokenizer, models, normalizers, pre_tokenizers, processors

from ldo_service.detection.labellers.text_embeddings import unit
from ldo_service.detection.onnx_network import Network
from ldo_service.errors import ModelError

TOKENS, MASK, SEGMENTS = "input_ids", "attention_mask", "token_type_ids"  # Inputs of the network.
POOLED = "sentence_embedding"  # Output of a network that pools its tokens itself.
# Maximum tokens of a text. A name has at most 100 characters, and BERT's networks take 512 tokens.
MAX_TOKENS = 128
MAX_TOKENIZER_BYTES = 1 << 26  # Maximum size of a tokenizer file; that of MiniLM has 0.5 MB.
START, END, UNKNOWN = "[CLS]", "[SEP]", "[UNK]"  # Special tokens of WordPiece in BERT.
_KINDS: dict[str, type[np.integer]] = {"tensor(int64)": np.int64, "tensor(int32)": np.int32}
_EXPECTED = (
    f"Expected: {TOKENS} and {MASK}, and optionally {SEGMENTS}, each int64 or int32 [1, length]. "
    "Export the network with these inputs, as optimum-cli does for the task feature-extraction."
)


class SentenceEncoder:
    """Embeddings of texts by the network and the tokenizer of one sentence encoder.

    Attributes:
        dimensions: Number of dimensions D of an embedding.
    """

    def __init__(self, file: Path, tokenizer: Path, device: str = "cpu", threads: int = 1) -> None:
        """Open an encoder, and encode one word as a check.

        Args:
            file: The network in ONNX.
            tokenizer: Its tokenizer: tokenizer.json, or the vocabulary vocab.txt of WordPiece.
            device: Setting `service.device`.
            threads: Threads of one inference.

        Raises:
            ModelError: If a file cannot be read, or the files are not a sentence encoder.
        """
        self._network = Network(file, device, threads)
        self._inputs, length = _inputs_of(self._network)
        self._tokenizer = read_sentence_tokenizer(tokenizer)
        self._tokenizer.enable_truncation(min(length or MAX_TOKENS, MAX_TOKENS))
        self._tokenizer.no_padding()  # The file may state a length, which would cost time only.
        if length:
            self._tokenizer.enable_padding(length=length)
        self._output = _output_of(self._network)
        self.dimensions = len(self._embed("chair"))

    def encode(self, texts: Sequence[str]) -> np.ndarray:
        """Return the embeddings of T texts, [T, D] float32 of length 1.

        A text longer than 128 tokens is cut. The embedding of a text does not depend on the others.

        Raises:
            ModelError: If the inference fails.
        """
        return np.array([self._embed(text) for text in texts]).reshape(-1, self.dimensions)

    def _embed(self, text: str) -> np.ndarray:
        """Return the embedding of a text, [D] float32 of length 1."""
        encoded = self._tokenizer.encode(text)
        values = {
            TOKENS: encoded.ids,
            MASK: encoded.attention_mask,
            SEGMENTS: encoded.type_ids,
        }
        inputs = {name: np.array([values[name]], kind) for name, kind in self._inputs.items()}
        output = self._network.run(**inputs)[self._output]
        if self._network.outputs[self._output] == POOLED:
            return unit(_required(output, (1, output.shape[-1]))[0])
        length = len(encoded.ids)
        tokens = _required(output, (1, length, output.shape[-1]))[0]
        weights = np.array(encoded.attention_mask, np.float32)
        return unit(weights @ tokens / max(weights.sum(), 1))


def read_sentence_tokenizer(path: Path) -> Tokenizer:
    """Return the tokenizer in a file.

    Args:
        path: A tokenizer.json of the library `tokenizers`, recognized by the suffix .json. A file
            with another suffix is a vocabulary of WordPiece, one token per line, as in BERT. Its
            texts are converted to lower case if no word of the vocabulary has an upper case letter.

    Raises:
        ModelError: If the file cannot be read or is not a tokenizer.
    """
    try:
        if path.stat().st_size > MAX_TOKENIZER_BYTES:
            raise ModelError(
                f"{path} has more than {MAX_TOKENIZER_BYTES} bytes, so it is no tokenizer. Give "
                "the tokenizer.json or vocab.txt of the sentence encoder."
            )
        text = path.read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ModelError(
            f"the tokenizer {path} cannot be read: {error}. Give the tokenizer.json or vocab.txt "
            "of the sentence encoder."
        ) from error
    if path.suffix != ".json":
        return _word_pieces(text, path)
    try:
        return Tokenizer.from_str(text)
    except Exception as error:  # The library raises no other class.
        raise ModelError(
            f"{path} is not a tokenizer.json of the library `tokenizers`: {error}. Give the "
            "tokenizer.json or vocab.txt of the sentence encoder."
        ) from error


def _word_pieces(text: str, path: Path) -> Tokenizer:
    """Return the tokenizer of BERT with the vocabulary in a text.

    Raises:
        ModelError: If the vocabulary lacks a special token.
    """
    ids = dict(zip(text.splitlines(), count(), strict=False))
    missing = [token for token in (START, END, UNKNOWN) if token not in ids]
    if missing:
        raise ModelError(
            f"{path} is not a vocabulary of WordPiece: it lacks {', '.join(missing)}. Give the "
            "tokenizer.json or vocab.txt of the sentence encoder."
        )
    is_lower = all(token == token.lower() for token in ids if not token.startswith("["))
    tokenizer = Tokenizer(models.WordPiece(ids, unk_token=UNKNOWN))
    tokenizer.normalizer = normalizers.BertNormalizer(lowercase=is_lower)
    tokenizer.pre_tokenizer = pre_tokenizers.BertPreTokenizer()
    tokenizer.post_processor = processors.BertProcessing((END, ids[END]), (START, ids[START]))
    return tokenizer


def _inputs_of(network: Network) -> tuple[dict[str, type[np.integer]], int | None]:
    """Return the type of each input by name, and the number of tokens; None if it may vary.

    Raises:
        ModelError: If the network has other inputs.
    """
    kinds = {name: kind for name, kind, _ in network.inputs}
    lengths = {shape[1] for *_, shape in network.inputs if len(shape) == 2}
    fixed = {length for length in lengths if isinstance(length, int)}
    fits = {TOKENS, MASK} <= kinds.keys() <= {TOKENS, MASK, SEGMENTS}
    fits = fits and all(kind in _KINDS for kind in kinds.values()) and len(fixed) <= 1
    if (
        not fits
        or any(len(shape) != 2 for *_, shape in network.inputs)
        or min(fixed, default=3) < 3
    ):
        found = ", ".join(f"{name} {kind} {shape}" for name, kind, shape in network.inputs)
        raise ModelError(f"the network's inputs are {found}. {_EXPECTED}")
    return {name: _KINDS[kind] for name, kind in kinds.items()}, next(iter(fixed), None)


def _output_of(network: Network) -> int:
    """Return the index of the output that is used: the pooled one, or else the first one."""
    return network.outputs.index(POOLED) if POOLED in network.outputs else 0


def _required(output: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return an output if it has the right shape.

    Raises:
        ModelError: If the shape is wrong, or the embedding has fewer than two dimensions.
    """
    if output.shape != shape or output.shape[-1] < 2:
        raise ModelError(
            f"the network's output has the shape {list(output.shape)}. Expected: {POOLED} of shape "
            "[1, D], or else a first output of shape [1, length, D] with one vector per token. "
            "Export the network as optimum-cli does for the task feature-extraction."
        )
    return output.astype(np.float32)
