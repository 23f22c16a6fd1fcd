"""Text as the numbers that CLIP's text encoder reads: byte pair encoding (Sennrich, ACL 2016).

A word begins as its UTF-8 bytes, the last one marked as an end. The pair of neighbours that stands
first in the list of merges becomes one, until none is in the list.
"""

import gzip
import re
import zlib
from collections.abc import Iterator
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np

from ldo_service.errors import ModelError

END = "</w>"
# CLIP's vocabulary of 49,408 less the 512 bytes and the two marks; its file goes on beyond.
MOST_MERGES = 49_408 - 512 - 2
LARGEST_BYTES = 1 << 26  # unpacked; CLIP's has 3 MB
_WORDS = re.compile(r"'(?:s|t|re|ve|m|ll|d)|[^\W\d_]+|\d|(?:[^\s\w]|_)+")

Pair = tuple[str, str]


class BytePairs:
    """A tokenizer, from the merges in order of their rank.

    The bytes are numbered as GPT-2 has it, first those that print; then the same as ends of words,
    the merges, and the marks of start and end of a text.
    """

    def __init__(self, merges: list[Pair]) -> None:
        letters = list(_letters().values())
        symbols = [*letters, *(letter + END for letter in letters), *map("".join, merges)]
        self._ranks = {pair: rank for rank, pair in enumerate(merges)}
        self._ids = {symbol: number for number, symbol in enumerate(symbols)}
        self.start, self.end = len(symbols), len(symbols) + 1

    @staticmethod
    def read(path: Path) -> "BytePairs":
        """From a file as CLIP's bpe_simple_vocab_16e6.txt.gz: a line about itself, then a pair a
        line. Raises ModelError."""
        _, *lines = _text(path).splitlines() or [""]
        merges = [tuple(line.split()) for line in lines[:MOST_MERGES] if line.strip()]
        if not merges or any(len(pair) != 2 for pair in merges):
            raise ModelError(
                f"{path} is no list of byte pairs: a line about itself is expected, then two "
                "symbols a line, as in CLIP's bpe_simple_vocab_16e6.txt.gz."
            )
        return BytePairs([(pair[0], pair[1]) for pair in merges])

    def __len__(self) -> int:
        return self.end + 1

    def encode(self, text: str, length: int) -> np.ndarray:
        """[length] int64: start, the text, end, zeros. What is too long loses its last words."""
        inner = [number for word in _words(text) for number in self._of_word(word)]
        marked = [self.start, *inner[: length - 2], self.end]
        return np.array(marked + [0] * (length - len(marked)), np.int64)

    def _of_word(self, word: str) -> list[int]:
        letters = _letters()
        symbols = [letters[byte] for byte in word.encode()]
        symbols[-1] += END
        while pair := self._first_pair(symbols):
            symbols = list(_merged(symbols, pair))
        return [self._ids[symbol] for symbol in symbols]

    def _first_pair(self, symbols: list[str]) -> Pair | None:
        known = [pair for pair in pairwise(symbols) if pair in self._ranks]
        return min(known, key=self._ranks.__getitem__, default=None)


def _words(text: str) -> list[str]:
    return _WORDS.findall(text.lower())


def _merged(symbols: list[str], pair: Pair) -> Iterator[str]:
    place = 0
    while place < len(symbols):
        is_pair = tuple(symbols[place : place + 2]) == pair
        yield "".join(pair) if is_pair else symbols[place]
        place += 2 if is_pair else 1


@cache
def _letters() -> dict[int, str]:
    """A printing character for each byte: its own where Latin-1 has one, else from 256 on."""
    printing = [*range(33, 127), *range(161, 173), *range(174, 256)]
    others = [byte for byte in range(256) if byte not in printing]
    return {byte: chr(byte) for byte in printing} | {
        byte: chr(256 + number) for number, byte in enumerate(others)
    }


def _text(path: Path) -> str:
    try:
        body = path.read_bytes()
        if body.startswith(b"\x1f\x8b"):
            with gzip.open(path) as file:
                body = file.read(LARGEST_BYTES + 1)
        if len(body) > LARGEST_BYTES:
            raise ModelError(f"{path} unpacks to more than {LARGEST_BYTES} bytes.")
        return body.decode("utf-8")
    except (OSError, EOFError, zlib.error, UnicodeDecodeError) as error:
        raise ModelError(f"the byte pairs in {path} cannot be read: {error}.") from error
