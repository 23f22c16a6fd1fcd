"""One file of a recording, as it is written: MCAP, which has readers in many languages.

Records are not chunked: writing costs a fifth, and a file that was cut off by a kill or a full
disk is good up to its last whole record.
"""

import logging
import shutil
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, cast

import msgspec
from mcap.writer import CompressionType, Writer

from ldo_service.errors import ConfigError

from .journal import CHANNELS, Entry

log = logging.getLogger(__name__)

ABOUT = "ldo/recording"  # name of the metadata record
CHECK_EVERY_BYTES = 64_000_000  # limits are looked at so often: 10 ms of a fast disk


@dataclass(frozen=True, slots=True)
class RecordConfig:
    """What a recording may cost. 640x480 at 30 Hz makes 100 MB a second."""

    max_gb: float = 50.0  # of the whole folder; more is not recorded
    min_free_gb: float = 1.0  # left on the disk for everything else, such as the actors' states
    queue_mb: float = 256.0  # per actor, in memory: 2 s of frames when the disk is busy elsewhere

    def __post_init__(self) -> None:
        if self.max_gb <= 0 or self.queue_mb <= 0 or self.min_free_gb < 0:
            raise ConfigError(f"{self}: sizes must be positive.")


class RecordingFile:
    """Opened new, written by one thread. After an error, or at a limit, it takes nothing more."""

    def __init__(self, path: Path, about: Mapping[str, str], config: RecordConfig) -> None:
        """Raises OSError when the file exists or cannot be written."""
        self.path, self._config = path, config
        self._file: BinaryIO = path.open("xb")
        self._writer = Writer(self._file, compression=CompressionType.NONE, use_chunking=False)
        self._writer.start(profile="ldo", library="ldo-slam")
        self._writer.add_metadata(ABOUT, dict(about))
        self._file.flush()
        self._channels: dict[str, int] = {}
        self._log_ns = 0  # of the last record
        self._unchecked = 0
        self.is_open = True

    def add_entry(self, entry: Entry) -> None:
        body = msgspec.msgpack.encode(entry)
        self.add(CHANNELS[type(entry)], type(entry), body, entry.step, time.time_ns())

    def add(
        self, topic: str, kind: type, body: bytes | memoryview, number: int, stamp_ns: int
    ) -> None:
        """Append a message of type `kind`; its publish time is `stamp_ns`."""
        if not self.is_open:
            return
        data = cast(bytes, body)  # a view is written without a copy
        try:
            self._log_ns = max(time.time_ns(), self._log_ns + 1)  # tools sort by it
            self._writer.add_message(
                self._channel(topic, kind), self._log_ns, data, stamp_ns, number
            )
            self._file.flush()
        except OSError as error:
            self._give_up(error)
        self._unchecked += len(body)

    def _channel(self, topic: str, kind: type) -> int:
        if topic not in self._channels:
            schema = msgspec.json.encode(msgspec.json.schema(kind))
            schema_id = self._writer.register_schema(kind.__name__, "jsonschema", schema)
            self._channels[topic] = self._writer.register_channel(topic, "msgpack", schema_id)
        return self._channels[topic]

    def is_over_limit(self) -> bool:
        """Whether the folder has grown too large, or the disk too full."""
        if self._unchecked < CHECK_EVERY_BYTES:
            return False
        self._unchecked = 0
        folder = self.path.parent
        used = sum(file.stat().st_size for file in folder.glob("*.mcap"))
        free = shutil.disk_usage(folder).free
        return used > self._config.max_gb * 1e9 or free < self._config.min_free_gb * 1e9

    def close(self) -> None:
        """Write the summary, which lets tools open the file at once."""
        if not self.is_open:
            return
        try:
            self._writer.finish()
            self._file.close()
        except OSError as error:
            self._give_up(error)
        self.is_open = False

    def _give_up(self, error: OSError) -> None:
        """What was written before stays readable. The robot goes on."""
        log.error("%s: %s: this recording ends here", self.path, error.strerror)
        self.abandon()

    def abandon(self) -> None:
        """Take nothing more, and leave the end as it is."""
        self.is_open = False
        with suppress(OSError):  # what it could not flush
            self._file.close()
