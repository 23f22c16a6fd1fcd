"""Format of the log lines of all commands."""

import logging


class OneLineFormatter(logging.Formatter):
    """Formatter that escapes control characters, so that one message is one line.

    Messages may contain text of other programs, which could otherwise forge further lines or
    control the terminal. Tracebacks keep their lines.
    """

    def __init__(self) -> None:
        super().__init__("%(asctime)s %(levelname).1s %(name)s: %(message)s", "%H:%M:%S")

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802
        """Return the line of a record, without its traceback."""
        line = super().formatMessage(record)
        if line.isprintable():
            return line
        return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in line)
