"""Byte pairs, against an example worked by hand and against numbers that CLIP is known for."""

from pathlib import Path

import pytest

from ldo_service.detection.labellers.text_embeddings import MAX_MERGES, BpeTokenizer
from ldo_service.errors import ModelError

from .encoders import vocabulary

HAND = (("l", "o"), ("lo", "w</w>"), ("e", "r</w>"))


def test_an_example_by_hand() -> None:
    """low: l o w</w>, lo w</w>, low</w>. lower: l o w e r</w>, lo w e r</w>, lo w er</w>.

    Bytes that print count from "!", so w is 119 - 33; the end of a word is 256 later.
    """
    pairs = BpeTokenizer(list(HAND))
    start, end = 515, 516
    expected = [start, 513, 512, 86, 514, 256, end, 0, 0]
    assert pairs.encode("Low  LOWER!", 9).tolist() == expected
    assert len(pairs) == 517


def test_numbers_that_clip_is_known_for() -> None:
    """49,408 tokens, start 49406, end 49407, "a" 320, "." 269, whatever its merges are."""
    pairs = BpeTokenizer([(f"x{n}", "y") for n in range(MAX_MERGES)])
    assert pairs.encode("a .", 5).tolist() == [49406, 320, 269, 49407, 0]
    assert len(pairs) == 49408


def test_a_long_text_loses_its_last_words_and_keeps_its_end() -> None:
    pairs = BpeTokenizer(list(HAND))
    tokens = pairs.encode("low " * 40, 7).tolist()
    assert tokens == [pairs.start, 513, 513, 513, 513, 513, pairs.end]


def test_words_are_cut_as_clip_cuts_them() -> None:
    pairs = BpeTokenizer(list(HAND))
    two = pairs.encode("2x4", 8).tolist()  # digits stand alone
    assert two[1:4] == [ord("2") - 33 + 256, ord("x") - 33 + 256, ord("4") - 33 + 256]
    # a letter of two bytes, neither of which prints: C3 prints as itself, A9 too
    assert len(pairs.encode("é", 8).nonzero()[0]) == 4


def test_a_file_is_read_packed_or_plain(tmp_path: Path) -> None:
    path = vocabulary(tmp_path / "bpe.txt.gz", ("l o", "lo w</w>", "e r</w>"))
    (tmp_path / "bpe.txt").write_text("#version\nl o\nlo w</w>\ne r</w>\n")
    read = [BpeTokenizer.read(path), BpeTokenizer.read(tmp_path / "bpe.txt")]
    assert {tuple(pairs.encode("low", 5)) for pairs in read} == {(515, 513, 516, 0, 0)}


@pytest.mark.parametrize("body", [b"", b"\x1f\x8bgarbage", b"#v\none two three\n", b"\xff\xfe\n"])
def test_garbage_is_no_list_of_pairs(tmp_path: Path, body: bytes) -> None:
    (tmp_path / "bpe").write_bytes(body)
    with pytest.raises(ModelError, match="byte pairs"):
        BpeTokenizer.read(tmp_path / "bpe")
