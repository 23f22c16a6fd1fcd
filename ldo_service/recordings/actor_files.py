"""Files of an actor in a recording, such as keyframe images and Gaussians of the mapper.

A saved state of the mapper refers to files in the mapper's folder, so a restored mapper needs the
state and the files. The folder `<actor>.files` of a recording holds these files. `Started.files`
lists the files that one start of the actor needs, each with its CRC-32. A file that several starts
need is stored once.
"""

import errno
import os
import re
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from ldo_service.errors import DataError
from ldo_service.runtime.journal import checksum
from ldo_service.storage.atomic_write import UNFINISHED

from .mcap_file import FILES_SUFFIX, RecordConfig, recording_bytes

# Form of a path in a recording. A recording may come from another machine, so its paths must not
# lead out of the actor's folder.
PATH = re.compile(r"\w+/\d+\.\w+")
CHECKSUM = re.compile(r"[0-9a-f]{8}")


@dataclass(frozen=True, slots=True)
class ActorFiles:
    """Files to which the saved state of an actor refers.

    Attributes:
        folder: Folder of the actor; it need not exist.
        patterns: Glob patterns of the files, relative to `folder`, such as `images/*.keyframe`.
    """

    folder: Path
    patterns: tuple[str, ...]

    def paths(self) -> Iterator[str]:
        """Yield the paths of the files, relative to the folder."""
        for pattern in self.patterns:
            for path in sorted(self.folder.glob(pattern)):
                name = path.relative_to(self.folder).as_posix()
                if PATH.fullmatch(name):
                    yield name


class FileArchive:
    """Recorded files of one actor, in the folder `<actor>.files` of a recording."""

    def __init__(self, journal: Path) -> None:
        """Determine the folder of the files; `add` creates it.

        Args:
            journal: MCAP file of a process of the actor, in the folder of the recording.
        """
        self._recording = journal.parent
        self.folder = journal.with_name(journal.name.partition(".")[0] + FILES_SUFFIX)

    def add(self, files: ActorFiles, config: RecordConfig) -> dict[str, str]:
        """Add the current files of an actor.

        The files become hard links, or copies if the recording is on another disk. A link is safe,
        because the actor replaces its files and never changes their content.

        Args:
            files: Files of the actor, which must not change during the call.
            config: Limits of the recording.

        Returns:
            The CRC-32 of each file, by its path relative to the actor's folder.

        Raises:
            OSError: A file cannot be read or added, or the recording would exceed a limit.
        """
        known = self._known()
        checksums: dict[str, str] = {}
        sources: list[tuple[Path, Path]] = []
        for name in files.paths():
            source = files.folder / name
            found = source.stat()
            key = name.replace("/", "."), found.st_size, found.st_mtime_ns
            checksums[name] = known.get(key) or checksum(source.read_bytes())
            target = self._path(name, checksums[name])
            if key not in known and not target.exists():
                sources.append((source, target))
        if sources:
            self._require_room(sum(source.stat().st_size for source, _ in sources), config)
            self.folder.mkdir(exist_ok=True)
        for source, target in sources:
            _link_or_copy(source, target, config)
        return checksums

    def restore(self, checksums: Mapping[str, str], folder: Path) -> None:
        """Replace the content of an actor's folder by the files of a recorded start of the actor.

        The files become symbolic links to the recording. If the actor removes or replaces a link,
        the recording does not change.

        Args:
            checksums: The CRC-32 of each file by its path, as `add` returned them.
            folder: Folder of the actor; its content is deleted.

        Raises:
            DataError: A file is missing or damaged, or a path is invalid.
        """
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True, exist_ok=True)
        for name, expected in checksums.items():
            if not (PATH.fullmatch(name) and CHECKSUM.fullmatch(expected)):
                raise DataError(
                    f"{self._recording} lists the file {name!r} with checksum {expected!r}, but a "
                    "path such as images/1.keyframe and a checksum of 8 hexadecimal digits are "
                    "expected. Copy the recording again, or make a new one."
                )
            kept = self._path(name, expected)
            self._require_unchanged(kept, expected)
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).symlink_to(kept.resolve())

    def _require_unchanged(self, kept: Path, expected: str) -> None:
        remedy = (
            f"A replay from a saved state needs all files of {self.folder}. Copy the whole folder "
            f"{self._recording} again, or make a new recording."
        )
        try:
            found = checksum(kept.read_bytes())
        except OSError as error:
            raise DataError(f"{kept} cannot be read: {error.strerror}. {remedy}") from error
        if found != expected:
            raise DataError(
                f"{kept} has changed: its checksum is {found}, but must be {expected}. {remedy}"
            )

    def _path(self, name: str, checksum: str) -> Path:
        return self.folder / f"{name.replace('/', '.')}.{checksum}"

    def _known(self) -> dict[tuple[str, int, int], str]:
        """Return the checksum of each recorded file, by its name, size and modification time.

        Links and copies keep the modification time, so an unchanged file is not read again at the
        next start.
        """
        known: dict[tuple[str, int, int], str] = {}
        if self.folder.exists():
            for path in self.folder.iterdir():
                name, _, suffix = path.name.rpartition(".")
                if CHECKSUM.fullmatch(suffix):
                    found = path.stat()
                    known[name, found.st_size, found.st_mtime_ns] = suffix
        return known

    def _require_room(self, added_bytes: int, config: RecordConfig) -> None:
        size_gb = 1e-9 * (recording_bytes(self._recording) + added_bytes)
        if size_gb > config.max_gb:
            raise OSError(
                errno.EFBIG,
                f"the new files have {1e-9 * added_bytes:.3g} GB, and would enlarge the recording "
                f"to {size_gb:.3g} GB, more than recording.max_gb={config.max_gb:g}",
            )


def _link_or_copy(source: Path, target: Path, config: RecordConfig) -> None:
    """Link a file, or copy it if it cannot be linked."""
    try:
        os.link(source, target)
    except OSError:
        free_gb = 1e-9 * (shutil.disk_usage(target.parent).free - source.stat().st_size)
        if free_gb < config.min_free_gb:
            raise OSError(
                errno.ENOSPC,
                f"a copy of {source} would leave {free_gb:.3g} GB of the disk free, less than "
                f"recording.min_free_gb={config.min_free_gb:g}",
            ) from None
        unfinished = target.with_name(target.name + UNFINISHED)
        try:
            shutil.copy2(source, unfinished)
            unfinished.replace(target)
        except BaseException:
            unfinished.unlink(missing_ok=True)
            raise
