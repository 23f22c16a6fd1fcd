"""Sentence encoder against a manual mean of token vectors, and defects of its files."""

from pathlib import Path

import numpy as np
import pytest
from onnx import TensorProto

from ldo_service.detection.sentence_encoder import SentenceEncoder, read_sentence_tokenizer
from ldo_service.errors import ModelError

from .sentence_encoders import WORDS, TinyEncoder, write_vocabulary


def encoder(folder: Path, tiny: TinyEncoder) -> SentenceEncoder:
    return SentenceEncoder(tiny.network(folder / "m.onnx"), write_vocabulary(folder / "vocab.txt"))


@pytest.mark.parametrize(
    "tiny",
    [
        TinyEncoder(),
        TinyEncoder(length=9),
        TinyEncoder(inputs=("input_ids", "attention_mask"), integer=TensorProto.INT32),
    ],
)
def test_embedding_is_the_scaled_mean_of_token_vectors(tmp_path: Path, tiny: TinyEncoder) -> None:
    """The vectors of the start and the end of a text are 0, and padding does not count."""
    rows = encoder(tmp_path, tiny).encode(["Chair couch", "sit"])
    mean = np.add(WORDS["chair"], WORDS["couch"])
    np.testing.assert_allclose(rows, [mean / np.linalg.norm(mean), WORDS["sit"]], atol=1e-6)


def test_network_that_pools_is_not_pooled_again(tmp_path: Path) -> None:
    tiny = TinyEncoder(is_pooled=True, output="sentence_embedding")
    (row,) = encoder(tmp_path, tiny).encode(["chair couch"])
    most = np.maximum(WORDS["chair"], WORDS["couch"])
    np.testing.assert_allclose(row, most / np.linalg.norm(most), atol=1e-6)


@pytest.mark.parametrize(
    ("tiny", "complaint"),
    [
        (TinyEncoder(inputs=("input_ids",)), "inputs are input_ids"),
        (TinyEncoder(inputs=("tokens", "attention_mask")), "inputs are tokens"),
        (TinyEncoder(inputs=("input_ids", "attention_mask", "position_ids")), "position_ids"),
        (TinyEncoder(length=2), "inputs are"),
        (TinyEncoder(is_pooled=True), "output has the shape"),
    ],
)
def test_other_networks_are_refused(tmp_path: Path, tiny: TinyEncoder, complaint: str) -> None:
    with pytest.raises(ModelError, match=complaint):
        encoder(tmp_path, tiny)


@pytest.mark.parametrize(
    ("name", "body"),
    [
        ("v.txt", b"chair\n"),
        ("v.txt", b"\xff"),
        ("t.json", b"{}"),
        ("t.json", b"no"),
        ("absent", None),
    ],
)
def test_invalid_tokenizer_is_refused(tmp_path: Path, name: str, body: bytes | None) -> None:
    if body is not None:
        (tmp_path / name).write_bytes(body)
    with pytest.raises(ModelError, match=r"vocab\.txt"):
        read_sentence_tokenizer(tmp_path / name)


def test_both_kinds_of_tokenizer_file_are_equal(tmp_path: Path) -> None:
    words = read_sentence_tokenizer(write_vocabulary(tmp_path / "vocab.txt"))
    words.enable_padding(length=20)
    words.save(str(tmp_path / "tokenizer.json"))
    net = TinyEncoder().network(tmp_path / "m.onnx")
    rows = [
        SentenceEncoder(net, tmp_path / file).encode(["Chair, couch!"])
        for file in ("vocab.txt", "tokenizer.json")
    ]
    np.testing.assert_array_equal(*rows)
