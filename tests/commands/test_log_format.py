"""Tests of the log format."""

import logging
import sys

from ldo_service.commands.log_format import OneLineFormatter


def formatted(text: str, error: BaseException | None = None) -> str:
    where = (type(error), error, None) if error is not None else None
    record = logging.LogRecord("ldo", logging.INFO, __file__, 1, "from %s", (text,), where)
    return OneLineFormatter().format(record)


def test_control_characters_are_escaped_and_cannot_forge_a_line() -> None:
    line = formatted("a camera\n12:00:00 I ldo: forged\r\x1b[2J\u2028end")
    assert len(line.splitlines()) == 1
    assert line.endswith(r"from a camera\n12:00:00 I ldo: forged\r\x1b[2J\u2028end")


def test_other_scripts_and_tracebacks_stay_readable() -> None:
    assert formatted("\u00fc \u9f8d").endswith("\u00fc \u9f8d")
    assert "\nValueError: bad" in formatted("x", ValueError("bad")), sys.version
