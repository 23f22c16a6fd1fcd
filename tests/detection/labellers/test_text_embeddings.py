"""Byte-pair tokenizer against a manual example and the published token ids of CLIP."""

from itertools import islice, product
from pathlib import Path

import pytest
from tokenizers import Tokenizer, pre_tokenizers

from ldo_service.detection.labellers.text_embeddings import MAX_MERGES, read_tokenizer
from ldo_service.errors import ModelError

from .encoders import vocabulary

EXAMPLE_MERGES = ("l o", "lo w</w>", "e r</w>")
START, END = 515, 516


@pytest.fixture
def example_tokenizer(tmp_path: Path) -> Tokenizer:
    return read_tokenizer(vocabulary(tmp_path / "bpe.txt.gz", EXAMPLE_MERGES))


def test_tokens_match_a_manual_example(example_tokenizer: Tokenizer) -> None:
    """The merges of "low" are l o w</w>, lo w</w>, low</w>.

    The merges of "lower" are l o w e r</w>, lo w e r</w>, lo w er</w>.
    Ids of printable bytes start at "!", so w is 119 - 33; the last byte of a word is 256 later.
    """
    assert example_tokenizer.encode("Low  LOWER!").ids == [START, 513, 512, 86, 514, 256, END]
    assert example_tokenizer.encode("").ids == [START, END]


def test_vocabulary_size_and_ids_match_clip(tmp_path: Path) -> None:
    """CLIP has 49,408 tokens: start 49406, end 49407, "a" 320, "." 269, for any merges."""
    letters = sorted(pre_tokenizers.ByteLevel.alphabet())
    merges = islice(map(" ".join, product(letters, letters)), MAX_MERGES + 5)
    tokenizer = read_tokenizer(vocabulary(tmp_path / "bpe.txt.gz", tuple(merges)))
    assert tokenizer.encode("a .").ids == [49406, 320, 269, 49407]
    assert tokenizer.get_vocab_size() == 49408


def test_words_are_split_as_in_clip(example_tokenizer: Tokenizer) -> None:
    first, end = ord("!"), 256  # First id of bytes and offset at the end of a word.
    ids = [ord(digit) - first + end for digit in "2x4"]
    assert example_tokenizer.encode("2x4").ids[1:-1] == ids, "each digit is a token"
    assert len(example_tokenizer.encode("é").ids) == 4, "a letter of two bytes"
    assert example_tokenizer.encode("a²b").ids[1:-1] == example_tokenizer.encode("a ² b").ids[1:-1]
    assert example_tokenizer.encode("low_low").ids[1:-1] == [513, ord("_") - first + end, 513]
    marks = example_tokenizer.encode("<|endoftext|>").ids
    assert (marks.count(END), len(marks)) == (1, 2 + 13), "a mark inside a text is plain text"


def test_gzip_and_plain_files_are_equal(tmp_path: Path) -> None:
    path = vocabulary(tmp_path / "bpe.txt.gz", EXAMPLE_MERGES)
    (tmp_path / "bpe.txt").write_text("#version\nl o\nlo w</w>\ne r</w>\n")
    tokenizers = [read_tokenizer(path), read_tokenizer(tmp_path / "bpe.txt")]
    assert {tuple(tokenizer.encode("low").ids) for tokenizer in tokenizers} == {(START, 513, END)}


@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"#v\n",
        b"\x1f\x8bgarbage",
        b"#v\none two three\n",
        b"#v\none two\n",
        b"#v\nl o\nlow e\n",
        b"\xff\xfe\n",
    ],
)
def test_invalid_merges_file_raises(tmp_path: Path, body: bytes) -> None:
    (tmp_path / "bpe").write_bytes(body)
    with pytest.raises(ModelError, match="byte pairs"):
        read_tokenizer(tmp_path / "bpe")
