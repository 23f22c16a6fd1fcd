"""Recordings of a batch: found from paths, patterns, lists and buckets, with a content digest.

A source is the path of a recording, its address in a bucket, or `synthetic:NAME`. A folder that is
not a recording itself stands for the recordings directly in it. A pattern such as
`s3://bucket/night/*` stands for the recordings that it matches.
"""

import hashlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from ldo_service.datasets import find_layout
from ldo_service.errors import ConfigError, DataError, LdoError
from ldo_service.storage.atomic_write import UNFINISHED
from ldo_service.storage.temporary_folder import temporary_folder

from .store import Entry, open_store

SYNTHETIC = "synthetic:"
PATTERN = frozenset("*?[")
MAX_MIRRORED = 2000  # Maximum number of file names that are read to recognize a folder's layout.
# Suffixes of files that are cut off the name of a recording.
SUFFIXES = (".bag", ".mcap", ".db3", ".mkv", ".r3d", ".sens")


@dataclass(frozen=True, slots=True)
class Recording:
    """Recording of a batch.

    Attributes:
        source: Path, address or `synthetic:NAME`.
        name: Name of the recording, a valid name of a folder.
        size_bytes: Size of all files; 0 for a synthetic scene.
        content: Digest of the content, hexadecimal.
    """

    source: str
    name: str
    size_bytes: int
    content: str


def find_recordings(
    words: Iterable[str], note: Callable[[str], None]
) -> dict[str, LdoError | None]:
    """Find the recordings that the arguments of a command stand for.

    Args:
        words: The arguments: paths, addresses, patterns and `synthetic:NAME`.
        note: Function that is called with a sentence about arguments or entries that are not used.

    Returns:
        A dictionary in the order of the arguments, with each recording once. A found recording is
        a key with the value None; the key is its path, its address or `synthetic:NAME`. An argument
        without a recording is a key whose value is the error. Such an argument is a path that does
        not exist, a pattern without matches, a folder without recordings, or an address whose
        protocol is not installed.

    Raises:
        LdoError: No argument stands for a recording. The error is that of the first argument.
    """
    found = dict[str, LdoError | None]()
    for word in words:
        try:
            sources = list(_expanded(word, note))
        except LdoError as error:
            found[word] = error
            continue
        for source in sources:
            if source in found:
                note(f"{source} is given twice. It is run once.")
            else:
                found[source] = None
    errors = [error for error in found.values() if error]
    if errors and len(errors) == len(found):
        raise errors[0]
    return found


def listed(path: Path) -> list[str]:
    """Return the lines of a file of sources, without empty lines and comments (#).

    The folder of the file is put before each relative path.

    Raises:
        ConfigError: The file cannot be read.
    """
    try:
        lines = [line.strip() for line in path.expanduser().read_text().splitlines()]
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(
            f"the list of sources {path} cannot be read: {error}. Give a text file in UTF-8."
        ) from error
    words = [line for line in lines if line and not line.startswith("#")]
    return [
        word if _is_remote(word) or word.startswith((SYNTHETIC, "~")) else str(path.parent / word)
        for word in words
    ]


def measure(source: str) -> Recording:
    """Return a recording with its size and the digest of its content.

    The digest of local files is the SHA-256 of their names and contents. A bucket is not downloaded
    for the digest: the checksums of its listing (such as ETag) identify the contents.

    Raises:
        DataError: A file cannot be read.
    """
    if source.startswith(SYNTHETIC):
        return Recording(source, _folder_name(source), 0, _digest([source]))
    store = open_store(source)
    files = [file for file in store.files() if not file.name.endswith(UNFINISHED)]
    if not files:
        raise DataError(f"{source} does not exist or is empty. Check the path.")
    folder = store.local if store.is_local and store.local.is_dir() else None
    marks = []
    for file in files:
        path = store.path if folder is None else folder / file.name
        mark = _sha256(Path(path)) if store.is_local else file.mark
        marks.append(f"{file.name}\t{file.size_bytes}\t{mark}")
    size_bytes = sum(file.size_bytes for file in files)
    return Recording(source, _folder_name(store.name), size_bytes, _digest(marks))


def _expanded(word: str, note: Callable[[str], None]) -> Iterator[str]:
    if word.startswith(SYNTHETIC):
        yield word
        return
    store = open_store(word)
    if store.exists():
        if _is_recording(Entry(store, store.is_file())):
            yield store.url
            return
        found = [] if store.is_file() else store.entries()
        problem = f"{word} is not a recording and contains none."
    elif PATTERN.intersection(word):
        found = store.matches()
        problem = f"no recording matches {word}."
    else:
        raise DataError(f"{word} does not exist. Check the path.")
    recordings = [entry.store.url for entry in found if _is_recording(entry)]
    if not recordings:
        raise DataError(
            f"{problem} Check the path; `ldo run --help` lists the layouts of recordings."
        )
    if others := len(found) - len(recordings):
        note(f"{word}: {others} of {len(found)} entries are not recordings and are not used.")
    yield from recordings


def _is_recording(entry: Entry) -> bool:
    """Return whether a path has a layout that a run can read.

    The layout of a bucket is recognized from the names of its files alone: a temporary folder gets
    empty files and folders of the same names.
    """
    store = entry.store
    if store.is_local:
        return find_layout(store.local) is not None
    with temporary_folder() as folder:
        mirror = folder / (store.name or "bucket")
        if entry.is_file:
            mirror.touch()
        else:
            mirror.mkdir()
            for child in store.entries()[:MAX_MIRRORED]:
                path = mirror / child.store.name
                path.touch() if child.is_file else path.mkdir()
        return find_layout(mirror) is not None


def _is_remote(word: str) -> bool:
    return "://" in word


def _folder_name(name: str) -> str:
    """Convert a name to a folder name: replace every character that is unusual in folder names."""
    plain = PurePosixPath(name).stem if name.endswith(SUFFIXES) else name
    safe = "".join(c if c.isalnum() or c in "._-+@" else "-" for c in plain).strip(".-")
    return safe[:60] or "recording"


def _digest(parts: Iterable[str]) -> str:
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def _sha256(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise DataError(
            f"{path} cannot be read: {error.strerror}. Check its permissions."
        ) from error
