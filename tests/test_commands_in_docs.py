"""Commands in the manual, each of which `ldo` must accept."""

import contextlib
import functools
import io
import re
import shlex
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import pytest

from ldo_service.commands import cli
from ldo_service.config import load_config

ROOT = Path(__file__).parent.parent
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
BLOCK = re.compile(r"^```sh\n(.*?)^```", re.DOTALL | re.MULTILINE)
LDO = re.compile(r"^(?:[A-Z_]+=\S+ )*(?:\S*/)?ldo (?P<words>.*)")
INLINE = re.compile(r"`ldo ([a-z]+)((?: [^`]*)?)`")
AFTER = re.compile(r"\s(?:>|\||&&|&$|#|\().*")  # Shell operators and comments after the command.


def commands(text: str) -> Iterator[str]:
    """Yield the words after `ldo` on each line of a shell block; a backslash continues a line."""
    for block in BLOCK.findall(text):
        for line in block.replace("\\\n", " ").splitlines():
            if found := LDO.match(line.strip()):
                yield AFTER.sub("", found["words"])


def inline(text: str) -> Iterator[tuple[str, list[str]]]:
    """Yield verb and options of each command outside shell blocks; it may be incomplete."""
    for verb, rest in INLINE.findall(BLOCK.sub("", text)):
        yield verb, re.findall(r"--[a-z][a-z0-9-]*", rest)


def cases(find: Callable[[str], Iterator]) -> list:
    """Return one test case for each distinct command on each page."""
    return [
        pytest.param(one, id=f"{page.name}: {one}")
        for page in PAGES
        for one in dict.fromkeys(map(str, find(page.read_text())))
    ]


@pytest.fixture
def parsed(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Replace each verb by a function that records its name, and return the recorded names."""
    called: list[str] = []

    def recorder(name: str, verb: Callable[..., None]) -> Callable[..., None]:
        return functools.wraps(verb)(lambda *_, **__: called.append(name))

    verbs = {name: recorder(name, verb) for name, verb in cli.verbs().items()}
    monkeypatch.setattr(cli, "verbs", lambda: verbs)
    return called


@pytest.mark.parametrize("command", cases(commands))
def test_command_in_manual_parses(command: str, parsed: list[str]) -> None:
    words = shlex.split(command)
    if "--help" in words:
        with pytest.raises(SystemExit, match="0"):
            cli.main(words)
    else:
        cli.main(words)
        assert parsed == words[:1]
    load_config(settings=[after for word, after in pairwise(words) if word == "--set"])


@functools.cache
def help_of(verb: str) -> str:
    """Return the help text of a verb."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out), pytest.raises(SystemExit):
        cli.main([verb, "--help"])
    return out.getvalue()


def test_verbs_and_options_in_sentences_exist() -> None:
    for page in PAGES:
        for verb, options in inline(page.read_text()):
            assert verb in cli.verbs(), f"{page.name}: ldo {verb}"
            for option in options:
                assert f"{option} " in help_of(verb), f"{page.name}: ldo {verb} {option}"


def test_invalid_command_exits_with_code_2(parsed: list[str]) -> None:
    for wrong in ("serf", "serve --robots a", "run", "publish room --rate fast"):
        with pytest.raises(SystemExit) as exit_info:
            cli.main(shlex.split(wrong))
        assert exit_info.value.code == 2
    assert parsed == []
