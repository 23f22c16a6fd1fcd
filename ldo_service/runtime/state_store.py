"""Where the last state of each actor is kept, so that a successor goes on.

A state is a few named parts. Only a part that is a new object is written; parts are written to a
temporary name and renamed, so a reader finds the old or the new one, never half of one.
"""

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import msgspec
import numpy as np

from ldo_service.schemas import Array

from .actor import State

log = logging.getLogger(__name__)
ARRAY_CODE = 1  # MessagePack extension type of a NumPy array


class StateStore(Protocol):
    def save(self, actor: str, state: State) -> None: ...

    def load(self, actor: str) -> State | None: ...


class MemoryStore:
    """Outlives an actor that failed, not its process."""

    def __init__(self) -> None:
        self._states: dict[str, State] = {}

    def save(self, actor: str, state: State) -> None:
        if state:
            self._states[actor] = dict(state)

    def load(self, actor: str) -> State | None:
        return self._states.get(actor)


class FolderStore:
    """`<folder>/<actor>/<part>.msgpack`: outlives a killed process.

    Not synced to the disk at each step: a power cut may cost the last seconds.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._written: dict[tuple[str, str], Any] = {}

    def save(self, actor: str, state: State) -> None:
        for part, value in state.items():
            if self._written.get((actor, part)) is not value:
                self._write(self._folder / actor / f"{part}.msgpack", value)
                self._written[actor, part] = value

    def _write(self, path: Path, value: object) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_suffix(".new")
        temporary.write_bytes(encode_state(value))
        temporary.rename(path)

    def load(self, actor: str) -> State | None:
        """None when nothing was saved, or what was saved cannot be read: said in the log."""
        try:
            parts = {
                path.stem: decode_state(path.read_bytes())
                for path in sorted((self._folder / actor).glob("*.msgpack"))
            }
        except (OSError, msgspec.DecodeError, ValueError) as error:
            log.error("%s: its saved state cannot be read and is left out: %s", actor, error)
            return None
        return parts or None


def encode_state(value: object) -> bytes:
    """Plain values, bytes and NumPy arrays as MessagePack."""
    return msgspec.msgpack.encode(value, enc_hook=_array_to_ext)


def decode_state(body: bytes) -> Mapping[str, Any]:
    return msgspec.msgpack.decode(body, ext_hook=_array_from_ext)


def _array_to_ext(value: object) -> msgspec.msgpack.Ext:
    if isinstance(value, np.generic):
        value = np.asarray(value)
    if not isinstance(value, np.ndarray):
        raise NotImplementedError(f"{type(value).__name__} in an actor's state")
    return msgspec.msgpack.Ext(ARRAY_CODE, msgspec.msgpack.encode(Array.of(value)))


def _array_from_ext(code: int, data: memoryview) -> np.ndarray:
    if code != ARRAY_CODE:
        raise ValueError(f"unknown extension {code} in a saved state")
    return msgspec.msgpack.decode(data, type=Array).numpy().copy()
