"""Parsing of the arguments of a verb; every error is one paragraph."""

import functools
import io
import re
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr

import tyro

from ldo_service.errors import ConfigError

CONFIG = (tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff)
STYLE = re.compile(r"\x1b\[[\d;]*m")  # Colors and other styles of a terminal.
SIDES = "│ "  # Characters at both ends of a line in a box.
EDGES = "─-╭╮╰╯"  # Characters of the edges of a box, and of the lines between its sections.


def parse(verb: Callable[..., None], name: str, words: Sequence[str]) -> Callable[[], None]:
    """Return the call of a verb with its parsed arguments.

    Args:
        verb: Function of the verb; its signature describes the arguments.
        name: Name of the verb.
        words: Arguments to parse.

    Raises:
        ConfigError: An argument is unknown, missing or malformed.
        SystemExit: The arguments ask for the help, which was printed.
    """

    @functools.wraps(verb)
    def later(*values: object, **options: object) -> Callable[[], None]:
        return functools.partial(verb, *values, **options)

    printed = io.StringIO()
    try:
        with redirect_stderr(printed):
            return tyro.cli(later, prog=f"ldo {name}", args=words, config=CONFIG)
    except SystemExit as leaving:
        if leaving.code:
            raise ConfigError(one_paragraph(printed.getvalue())) from None
        raise


def one_paragraph(box: str) -> str:
    """Return the text of an error that tyro has printed as a box, without the title of the box."""
    sections: list[list[str]] = [[]]
    for line in STYLE.sub("", box).splitlines()[1:]:
        text = line.strip(SIDES)
        if text.strip(EDGES):
            sections[-1].append(text)
        else:
            sections.append([])
    sentences = [" ".join(lines).rstrip(".!") + "." for lines in sections if lines]
    text = " ".join(sentences)
    return text[:1].lower() + text[1:]
