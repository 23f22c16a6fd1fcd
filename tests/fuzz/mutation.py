"""Mutations of valid bytes, because noise alone would not pass the first check of a reader."""

from collections.abc import Sequence

from hypothesis import strategies as st

# Words that are difficult for readers of text and numbers.
WORDS = (
    *(b"nan", b"-inf", b"1e999", b"-1", b"0", b"99999999999999999999", b"1.#IND", b"null", b"true"),
    *(b"[]", b"{}", b'""', b"\\ud800", b"..", b"/", b"\n", b",", b":", b"#", b"&a *a", b"!!set {}"),
    *(b"[" * 5000, b"{a: " * 2000, b"\x91" * 5000),
    *(b"\0", b"\xff\xff\xff\xff", b"\x7f\xff\xff\xff", b"\xcb\x7f\xf8", b"\xc0", b"\x80", b"\xc7"),
)
MAX_BYTES = 1 << 16


@st.composite
def mutated(draw: st.DrawFn, seeds: Sequence[bytes]) -> bytes:
    """Draw a seed with one to four edits, or sometimes noise."""
    body = draw(st.sampled_from(seeds) if draw(st.integers(0, 15)) else st.binary(max_size=64))
    for _ in range(draw(st.integers(1, 4))):
        body = _edited(draw, body)
    return body[:MAX_BYTES]


def _edited(draw: st.DrawFn, body: bytes) -> bytes:
    at = draw(st.integers(0, len(body)))
    end = min(len(body), at + draw(st.integers(0, 8)))
    match draw(st.sampled_from(("flip", "word", "cut", "leave out", "repeat"))):
        case "flip" if at < len(body):
            return body[:at] + bytes([draw(st.integers(0, 255))]) + body[at + 1 :]
        case "word":
            return body[:at] + draw(st.sampled_from(WORDS)) + body[end:]
        case "cut":
            return body[:at]
        case "leave out":
            return body[:at] + body[end:]
        case _:
            return body[:end] + body[at:end] * draw(st.integers(1, 3)) + body[end:]
