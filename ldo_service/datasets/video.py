"""Reader of the frames of a video, by PyAV."""

from bisect import bisect_left, bisect_right
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

from ldo_service.errors import ConfigError, DataError, FrameError, install_command

from .images import MAX_PIXELS


class Video:
    """Frames of a video file in the order of their stamps.

    If frames are read in order, each one is decoded once. If they are read in another order, the
    reader goes back to the preceding keyframe of the video and decodes frames again. At most one
    decoded frame is in memory. Several threads may read at the same time.

    Attributes:
        stamps_ns: Stamps of the frames from the beginning of the file, [N] int64, ascending.
        width: Width of the frames in pixels.
        height: Height of the frames in pixels.
    """

    def __init__(self, path: Path, stream: int = 0) -> None:
        """Open a file and list its frames, without decoding them.

        Args:
            path: The file.
            stream: Number of the stream among the video streams of the file.

        Raises:
            ConfigError: PyAV is not installed.
            DataError: The file cannot be read or has no frames.
        """
        try:
            import av  # The library is optional.
            from av.error import FFmpegError
        except ImportError as error:
            raise ConfigError(
                f"{path} is a video, which needs the extra `phones`. Install it by "
                f"{install_command('phones')}."
            ) from error
        self._path, self._error = path, FFmpegError
        try:
            self._container = av.open(str(path))
            self._stream: Any = self._container.streams.video[stream]
            self.width, self.height = int(self._stream.width), int(self._stream.height)
            packets = [
                (packet.pts, packet.is_keyframe)
                for packet in self._container.demux(self._stream)
                if packet.pts is not None and not packet.is_discard
            ]
        except (FFmpegError, IndexError, ValueError, AttributeError) as error:
            # A stream of an unknown codec has no width.
            raise DataError(
                f"{path} cannot be read as a video ({type(error).__name__}: {error}). It may be "
                "truncated. Export or copy the recording again."
            ) from error
        packets.sort()
        self._stamps = [stamp for stamp, _ in packets]  # The unit is that of the stream.
        self._keyframes = [k for k, (_, is_key) in enumerate(packets) if is_key] or [0]
        if not packets or not 0 < self.width * self.height <= MAX_PIXELS:
            raise DataError(
                f"{path} has {len(packets)} frames of {self.width}x{self.height} pixels, expected "
                f"at least one frame, with 1 to {MAX_PIXELS} pixels. Export the recording again."
            )
        unit = self._stream.time_base
        stamps_ns = [stamp * unit.numerator * 10**9 // unit.denominator for stamp in self._stamps]
        self.stamps_ns = np.array(stamps_ns, np.int64)
        self._frames: Iterator[Any] | None = None  # Decoded frames from `_next` on.
        self._next = 0
        self._missing = range(0)  # Frames before `_next` that the decoder did not deliver.
        self._lock = Lock()

    def __len__(self) -> int:
        return len(self._stamps)

    def read(self, index: int, encoding: str = "rgb24") -> np.ndarray:
        """Return a frame.

        Args:
            index: Index of the frame.
            encoding: Pixel format of the result, by FFmpeg's name.

        Returns:
            The frame in this pixel format; [H, W, 3] uint8 RGB for "rgb24".

        Raises:
            FrameError: The frame cannot be decoded.
        """
        with self._lock:
            frame = self._decoded(index)
            if frame is None:
                raise FrameError(
                    f"{self._path}, frame {index}, cannot be decoded. Export or copy the recording "
                    "again."
                )
            return frame.to_ndarray(format=encoding)

    def _decoded(self, index: int) -> Any:
        """Return the decoded frame with an index, or None if the decoder does not deliver it."""
        if index in self._missing:
            return None
        keyframe = self._keyframes[max(bisect_right(self._keyframes, index) - 1, 0)]
        if self._frames is not None and keyframe <= self._next <= index:
            return self._advance(index)
        self._seek(keyframe)
        frame = self._advance(index)
        if frame is None and keyframe > 0:  # The frame may refer to an earlier keyframe.
            self._seek(0)
            frame = self._advance(index)
        return frame

    def _seek(self, index: int) -> None:
        self._container.seek(self._stamps[index], stream=self._stream)
        self._frames, self._next, self._missing = self._decode(), index, range(0)

    def _advance(self, index: int) -> Any:
        """Decode frames up to the one with an index, and return this frame.

        The result is None if the decoder skips this frame. The next call then continues with the
        frame after it.
        """
        assert self._frames is not None
        for frame in self._frames:
            position = bisect_left(self._stamps, frame.pts)
            if position >= index:
                break
        else:
            self._frames = None
            return None
        if position > index:
            self._frames, self._next = chain([frame], self._frames), position
            self._missing = range(index, position)
            return None
        self._next = index + 1
        return frame

    def _decode(self) -> Iterator[Any]:
        """Yield all frames that can be decoded from the current position of the file on."""
        for packet in self._container.demux(self._stream):
            try:
                frames = packet.decode()
            except self._error:  # Damaged; `read` reports the frames that it misses.
                continue
            yield from (frame for frame in frames if frame.pts is not None)
