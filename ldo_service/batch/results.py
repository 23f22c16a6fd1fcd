"""Folders with the results of a batch: their publication, and the check whether they are complete.

`result.json` is written last. It lists every other file of the folder with its size and its SHA-256
checksum. Results are not finished if `result.json` or a listed file is missing, or if the size of a
file differs from the list.
"""

import hashlib
import shutil
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec

from ldo_service.errors import DataError
from ldo_service.runs.folder import WRITTEN
from ldo_service.storage.atomic_write import UNFINISHED

from .job import BatchJob, Outcome
from .store import Store, open_store, reason_of

RESULT, EVALUATION = "result.json", "eval.json"
ENTRY = "entry.json"  # Written instead of result.json up to version 0.1.
OWN = frozenset({*WRITTEN, RESULT, EVALUATION, ENTRY})
# Files that contain durations, the number of threads, or scores of the software that computed them.
VOLATILE = frozenset({"frames.csv", "summary.json", "loops.json", "config.yaml", EVALUATION})


class ResultFile(msgspec.Struct, frozen=True):
    """Size and checksum of a file in a folder of results."""

    size_bytes: int
    sha256: str  # SHA-256 of the content, hexadecimal.


class Result(msgspec.Struct, frozen=True, kw_only=True):
    """Content of result.json."""

    key: str  # Digest of everything that the results depend on; see `BatchJob.key`.
    outcome: Outcome  # Outcome of the recording.
    files: dict[str, ResultFile]  # Every other file of the folder, by name.


@dataclass(frozen=True, slots=True)
class ResultFolder:
    """Folder of the result of one recording."""

    store: Store  # The folder.
    key: str  # Key that the results in the folder must have; see `BatchJob.key`.

    @staticmethod
    def of(job: BatchJob) -> "ResultFolder":
        """Return the folder for the results of a job.

        Raises:
            ConfigError: The protocol of the folder's address, such as s3, is unknown or not
                installed.
        """
        return ResultFolder(open_store(job.out).at(job.folder), job.key)

    def finished(self) -> Outcome | None:
        """Return the outcome of the results in the folder, or None if they are not finished.

        Finished results are complete, and their `result.json` has the `key` of this folder. The key
        is a digest of everything that the results depend on.

        Raises:
            DataError: The folder cannot be read.
        """
        content = self.store.at(RESULT).read()
        try:
            result = msgspec.json.decode(content or b"", type=Result)
        except msgspec.DecodeError:
            return None
        sizes = {file.name: file.size_bytes for file in self.store.files()}
        is_complete = all(sizes.get(name) == f.size_bytes for name, f in result.files.items())
        if result.key != self.key or not is_complete:
            return None
        return msgspec.structs.replace(result.outcome, status="kept")

    def publish(self, made: Path, outcome: Outcome) -> Outcome:
        """Replace the content of this folder by the results in a local folder.

        Args:
            made: Local folder with the results. It is uploaded if this folder is in a bucket, and
                moved otherwise.
            outcome: Outcome of the recording, without the digest and the size of the results.

        Returns:
            The outcome with the digest and the size of the results.

        Raises:
            DataError: This folder cannot be written, or holds files that no batch wrote.
        """
        files = _files(made)
        size_bytes = sum(file.size_bytes for file in files.values())
        assert outcome.costs is not None
        costs = msgspec.structs.replace(outcome.costs, result_bytes=size_bytes)
        outcome = msgspec.structs.replace(outcome, digest=digest_of(files), costs=costs)
        content = msgspec.json.format(
            msgspec.json.encode(Result(key=self.key, outcome=outcome, files=files))
        )
        self._require_own()
        if self.store.is_local:
            self._move(made, content)
        else:
            self._upload(made, files, content)
        return outcome

    def _require_own(self) -> None:
        """Check that a batch wrote every file in the folder."""
        foreign = [f.name for f in self.store.files() if f.name.removesuffix(UNFINISHED) not in OWN]
        if foreign:
            raise DataError(
                f"{self.store.url} holds {foreign[0]}, which no run wrote, so nothing is replaced. "
                "Move the file, or choose another --out."
            )

    def _move(self, made: Path, content: bytes) -> None:
        target = self.store.local
        try:
            (made / RESULT).write_bytes(content)
            target.parent.mkdir(parents=True, exist_ok=True)
            with TemporaryDirectory(prefix=f"{UNFINISHED}-", dir=target.parent) as temporary:
                complete = Path(shutil.move(made, Path(temporary) / "made"))
                if target.exists():
                    target.rename(Path(temporary) / "old")
                complete.rename(target)
        except OSError as error:
            raise DataError(
                f"{target} cannot be written: {reason_of(error)}. Free some disk space, or choose "
                "another --out."
            ) from error

    def _upload(self, made: Path, files: dict[str, ResultFile], content: bytes) -> None:
        self.store.at(RESULT).remove()
        for file in self.store.files():
            self.store.at(file.name).remove()
        for name in files:
            self.store.at(name).upload(made / name)
        self.store.at(RESULT).write(content)


def digest_of(files: dict[str, ResultFile]) -> str:
    """Return a hexadecimal digest of all files whose content does not depend on timing.

    The digest also covers pictures. Two runs of the same recording with the same settings have the
    same digest, even on two machines, if the processors support the same instruction set.

    Args:
        files: Files by name, with their checksums.
    """
    lines = [f"{name} {f.sha256}" for name, f in sorted(files.items()) if name not in VOLATILE]
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()


def _files(folder: Path) -> dict[str, ResultFile]:
    found = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            with path.open("rb") as file:
                checksum = hashlib.file_digest(file, "sha256").hexdigest()
            name = path.relative_to(folder).as_posix()
            found[name] = ResultFile(path.stat().st_size, checksum)
    return found
