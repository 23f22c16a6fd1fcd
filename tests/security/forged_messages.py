"""Attempts with names that lead out of a folder and with forged files."""

import gzip
import io
import struct
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path
from unittest.mock import patch

import numpy as np
import onnx
import zstandard
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from ldo_service.actors.topology import actor_spec
from ldo_service.datasets import open_sequence
from ldo_service.detection.detectors import NetworkConfig
from ldo_service.detection.labellers import text_embeddings
from ldo_service.detection.labellers.text_embeddings import CachedEmbeddings, read_tokenizer
from ldo_service.detection.model_registry import Models
from ldo_service.errors import LdoError
from ldo_service.gaussians.file_formats import read_ply
from ldo_service.geometry import codecs
from ldo_service.recordings.mcap_file import McapIndex
from ldo_service.semantics.semantics_file import read_semantics
from ldo_service.transport.certificate_authority import CertificateAuthority
from ldo_service.transport.endpoint import Endpoint
from tests.detection.networks import SQUARES

from .attempt import Attempt, kept_in

REFUSED = "refused"
MAX_MEMORY_BYTES = 100_000_000  # Maximum memory that reading a file of some kilobytes may take.
LIES: list[Attempt[Path]] = []
attempt = kept_in(LIES)


def outcome_of(*calls: Callable[[], object]) -> str:
    """Return REFUSED if each call raises LdoError and takes little memory, else what one did."""
    for call in calls:
        tracemalloc.start()
        try:
            call()
            return "accepted"
        except LdoError:
            _, peak_bytes = tracemalloc.get_traced_memory()
            if peak_bytes > MAX_MEMORY_BYTES:
                return f"refused after allocating {peak_bytes / 1e6:.0f} MB"
        finally:
            tracemalloc.stop()
    return REFUSED


# --- names ----------------------------------------------------------------------------------------
@attempt("robots named `../up`, `a/b`, `*`, `**`, `$*`", REFUSED)
def robots(_folder: Path) -> str:
    names = ("../up", "a/b", "*", "**", "$*")
    return outcome_of(*(lambda name=name: Endpoint(name) for name in names))


@attempt("models named `../up`, `/tmp/up`, `.hidden`", REFUSED)
def models(folder: Path) -> str:
    file = SQUARES["yolox"].write(folder / "net.onnx")
    here = Models(folder / "models")
    names = ("../up", "/tmp/up", ".hidden")
    return outcome_of(*(lambda name=name: here.add(name, file, NetworkConfig()) for name in names))


@attempt("removing a model named `../keep`, a folder next to the models", "refused, kept")
def removed_models(folder: Path) -> str:
    (folder / "keep").mkdir()
    (folder / "models").mkdir()
    seen = outcome_of(lambda: Models(folder / "models").remove("../keep"))
    return f"{seen}, {'kept' if (folder / 'keep').exists() else 'gone'}"


@attempt("keys named `../up`, `a/b`, `.x`, removing keys named `..`", REFUSED)
def keys(folder: Path) -> str:
    authority = CertificateAuthority.new(folder / "keys", days=1)
    names = ("../up", "a/b", ".x")
    adds = [lambda name=name: authority.add(name, "viewer", "*", 1) for name in names]
    return outcome_of(*adds, lambda: authority.remove(".."))


@attempt("an actor named `../../bin/sh` for a process of its own", REFUSED)
def actors(_folder: Path) -> str:
    return outcome_of(lambda: actor_spec("../../bin/sh"))


@attempt("a data set that lists `../secret.png`, `/dev/zero`, `a/../../secret.png`", REFUSED)
def listed(folder: Path) -> str:
    def naming(name: str) -> Callable[[], object]:
        def open_it() -> object:
            for kind in ("rgb", "depth"):
                (folder / f"{kind}.txt").write_text(f"1.0 {name}\n")
            return open_sequence(str(folder))

        return open_it

    (folder / "camera.json").write_text('{"fx":1,"fy":1,"cx":1,"cy":1,"width":9,"height":9}')
    return outcome_of(*map(naming, ("../secret.png", "/dev/zero", "a/../../secret.png")))


# --- models ---------------------------------------------------------------------------------------
@attempt("a model that is garbage", REFUSED)
def garbage(folder: Path) -> str:
    (folder / "net.onnx").write_bytes(b"\x08\x07garbage" * 100)
    return outcome_of(lambda: Models(folder / "m").add("x", folder / "net.onnx", NetworkConfig()))


@attempt("a model with external weights in `../secret`", REFUSED)
def external_weights(folder: Path) -> str:
    (folder / "secret").write_bytes(bytes(1 << 20))
    model = onnx.load(SQUARES["yolox"].write(folder / "net.onnx"))
    for tensor in model.graph.initializer:
        if not tensor.raw_data:
            continue
        tensor.ClearField("raw_data")
        tensor.data_location = onnx.TensorProto.EXTERNAL
        tensor.external_data.add(key="location", value="../secret")
    onnx.save(model, folder / "net.onnx")
    return outcome_of(lambda: Models(folder / "m").add("x", folder / "net.onnx", NetworkConfig()))


@attempt("a registered model with a replaced file", REFUSED)
def exchanged(folder: Path) -> str:
    here = Models(folder / "models")
    file = SQUARES["yolox"].write(folder / "net.onnx")
    registered = here.add("x", file, NetworkConfig())
    SQUARES["yolov8"].write(registered.file)
    return outcome_of(here.get("x").verify)


@attempt("a tokenizer table (`bpe.txt.gz`) that unpacks from 78 kB to 80 MB", REFUSED)
def tokenizer_table(folder: Path) -> str:
    (folder / "bpe.txt.gz").write_bytes(gzip.compress(bytes(80_000_000)))
    return outcome_of(lambda: read_tokenizer(folder / "bpe.txt.gz"))


@attempt("embeddings with a pickle inside", "refused, not run")
def pickled(folder: Path) -> str:
    path, ran = folder / "e.npz", folder / "ran"
    np.savez(
        path, names=np.array([CreatesFile(ran)], object), embeddings=np.ones((1, 2), np.float32)
    )
    return f"{outcome_of(lambda: CachedEmbeddings(path))}, {'run' if ran.exists() else 'not run'}"


class CreatesFile:
    """An object that creates a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple:
        return Path.touch, (self.path,)


# --- archives -------------------------------------------------------------------------------------
@attempt("arrays that claim 2 TB, or unpack from 16 kB to 16 MB where 1 MB is the limit", REFUSED)
def large_arrays(folder: Path) -> str:
    names = npy(np.array(["a"]))
    lying, packed = folder / "lying.npz", folder / "packed.npz"
    with zipfile.ZipFile(lying, "w") as archive:
        archive.writestr("names.npy", names)
        archive.writestr("embeddings.npy", npy_header((1 << 39,)))
    np.savez_compressed(packed, names=np.array(["a"]), embeddings=np.ones((1, 1 << 22), "f4"))
    with patch.object(text_embeddings, "MAX_BYTES", 1_000_000):
        embeddings_outcome = outcome_of(
            lambda: CachedEmbeddings(lying), lambda: CachedEmbeddings(packed)
        )
    return (
        embeddings_outcome
        if embeddings_outcome != REFUSED
        else outcome_of(lambda: read_semantics(lying))
    )


@attempt("labels in an archive with a member `../../up.npy`", "refused, nothing written")
def members(folder: Path) -> str:
    inner = folder / "a" / "b"
    inner.mkdir(parents=True)
    with zipfile.ZipFile(inner / "s.npz", "w") as archive:
        archive.writestr("../../up.npy", npy(np.zeros(3)))
    seen = outcome_of(lambda: read_semantics(inner / "s.npz"))
    written = [path for path in folder.rglob("up*") if path.is_file()]
    return f"{seen}, {'something' if written else 'nothing'} written"


@attempt("a recording with a chunk that unpacks from 32 kB to 1 GB", REFUSED)
def chunk(folder: Path) -> str:
    body = zstandard.ZstdCompressor().compress(bytes(1 << 30))
    return outcome_of(
        *(lambda n=n: McapIndex(recording(folder, body, claimed_bytes=n)) for n in (10, 1 << 30))
    )


def recording(folder: Path, body: bytes, claimed_bytes: int) -> Path:
    """Write a recording with one chunk; its header states an unpacked size of `claimed_bytes`."""
    name = b"zstd"
    content = struct.pack("<QQQI", 0, 1, claimed_bytes, 0) + struct.pack("<I", len(name)) + name
    content += struct.pack("<Q", len(body)) + body
    path = folder / f"{claimed_bytes}.mcap"
    path.write_bytes(MCAP0_MAGIC + struct.pack("<BQ", Opcode.CHUNK, len(content)) + content)
    return path


@attempt("a map with 10^12 Gaussians in its header", REFUSED)
def large_map(folder: Path) -> str:
    properties = "".join(f"property float {name}\n" for name in ("x", "y", "z"))
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {10**12}\n{properties}end_header\n"
    )
    (folder / "map.ply").write_bytes(header.encode())
    return outcome_of(lambda: read_ply(folder / "map.ply"))


@attempt("a depth image of 4 kB that unpacks to 128 MB", REFUSED)
def large_depth(_folder: Path) -> str:
    body = memoryview(zstandard.ZstdCompressor().compress(bytes(1 << 27)))
    return outcome_of(lambda: codecs.decode_depth("z16+zstd", 64, 48, body))


def npy(values: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, values)
    return file.getvalue()


def npy_header(shape: tuple[int, ...]) -> bytes:
    """Return the header of a float32 array without the array."""
    file = io.BytesIO()
    about = {"descr": "<f4", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_2_0(file, about)
    return file.getvalue()
