"""Byte pairs, against an example worked by hand and against numbers that CLIP is known for."""

from itertools import islice, product
from pathlib import Path

import pytest
from tokenizers import Tokenizer, pre_tokenizers

from ldo_service.detection.labellers.text_embeddings import MAX_MERGES, read_tokenizer
from ldo_service.errors import ModelError

from .encoders import vocabulary

HAND = ("l o", "lo w</w>", "e r</w>")
START, END = 515, 516


@pytest.fixture
def by_hand(tmp_path: Path) -> Tokenizer:
    return read_tokenizer(vocabulary(tmp_path / "bpe.txt.gz", HAND))


def test_an_example_by_hand(by_hand: Tokenizer) -> None:
    """low: l o w</w>, lo w</w>, low</w>. lower: l o w e r</w>, lo w e r</w>, lo w er</w>.

    Bytes that print count from "!", so w is 119 - 33; the end of a word is 256 later.
    """
    assert by_hand.encode("Low  LOWER!").ids == [START, 513, 512, 86, 514, 256, END]
    assert by_hand.encode("").ids == [START, END]


def test_numbers_that_clip_is_known_for(tmp_path: Path) -> None:
    """49,408 tokens, start 49406, end 49407, "a" 320, "." 269, whatever its merges are."""
    letters = sorted(pre_tokenizers.ByteLevel.alphabet())
    merges = islice(map(" ".join, product(letters, letters)), MAX_MERGES + 5)
    tokenizer = read_tokenizer(vocabulary(tmp_path / "bpe.txt.gz", tuple(merges)))
    assert tokenizer.encode("a .").ids == [49406, 320, 269, 49407]
    assert tokenizer.get_vocab_size() == 49408


def test_words_are_cut_as_clip_cuts_them(by_hand: Tokenizer) -> None:
    first, end = ord("!"), 256  # of the numbers of bytes, and of those that end a word
    numbers = [ord(digit) - first + end for digit in "2x4"]
    assert by_hand.encode("2x4").ids[1:-1] == numbers, "digits stand alone"
    assert len(by_hand.encode("é").ids) == 4, "a letter of two bytes"
    assert by_hand.encode("a²b").ids[1:-1] == by_hand.encode("a ² b").ids[1:-1]
    assert by_hand.encode("low_low").ids[1:-1] == [513, ord("_") - first + end, 513]
    marks = by_hand.encode("<|endoftext|>").ids
    assert (marks.count(END), len(marks)) == (1, 2 + 13), "a mark in a text is no mark"


def test_a_file_is_read_packed_or_plain(tmp_path: Path) -> None:
    path = vocabulary(tmp_path / "bpe.txt.gz", HAND)
    (tmp_path / "bpe.txt").write_text("#version\nl o\nlo w</w>\ne r</w>\n")
    read = [read_tokenizer(path), read_tokenizer(tmp_path / "bpe.txt")]
    assert {tuple(tokenizer.encode("low").ids) for tokenizer in read} == {(START, 513, END)}


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
def test_garbage_is_no_list_of_pairs(tmp_path: Path, body: bytes) -> None:
    (tmp_path / "bpe").write_bytes(body)
    with pytest.raises(ModelError, match="byte pairs"):
        read_tokenizer(tmp_path / "bpe")
