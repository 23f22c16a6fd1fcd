"""Files of Gaussians that other programs read: PLY, .splat and .spz.

.ply    The format of 3D Gaussian splatting and its viewers.
.splat  32 bytes per Gaussian, and no header. Gaussians are sorted by opacity times volume,
        largest first. The bytes of a Gaussian are:
            position 3 float32 | scale 3 float32, meters | RGBA 4 uint8 | quaternion wxyz 4 uint8
        A quaternion component q is stored as the byte 128 (1 + q), so that a rotation is accurate
        to about half a degree.
        Axes are those of the map. Format: https://github.com/antimatter15/splat
.spz    Quantized and compressed to about a tenth of the size of a PLY.
        Means are fixed point with steps of 0.24 mm, up to 2 km. Log scales have steps of 1/16,
        opacity and color are bytes, and quaternions are accurate to about a tenth of a degree.
        Format: https://github.com/nianticlabs/spz

An .spz file has the axes of OpenGL: x right, y up, z back. `gsply.write_spz` does not convert
axes, so this module converts them from the axes of the map: x right, y down, z forward. Niantic's
library calls this conversion RDF to RUB. `GSData.save` of gsply is not used, because it always
writes a PLY, whatever the file extension.
"""

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ldo_service.errors import ConfigError, DataError, install_command

from .rows import aligned_rows

log = logging.getLogger(__name__)

SH_C0 = 0.28209479177387814  # The constant spherical harmonic, 1 / (2 sqrt(pi)).
PROPERTIES = (
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)
OF_A_ROW = (
    *("x", "y", "z", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
    *("opacity", "f_dc_0", "f_dc_1", "f_dc_2"),  # The last three columns of a row hold RGB.
)
COLUMNS = {name: column for column, name in enumerate(OF_A_ROW)}
# NumPy byte order of each PLY format; empty for text.
FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
TYPES = {
    name: kind
    for kind, names in (
        ("i1", ("char", "int8")),
        ("u1", ("uchar", "uint8")),
        ("i2", ("short", "int16")),
        ("u2", ("ushort", "uint16")),
        ("i4", ("int", "int32")),
        ("u4", ("uint", "uint32")),
        ("f4", ("float", "float32")),
        ("f8", ("double", "float64")),
    )
    for name in names
}
MAX_LINE = 4096  # Maximum length of a header line, bytes.
PLY_ADVICE = "Give a PLY file of 3D Gaussian splatting, such as the map.ply of a run."

SPLAT = np.dtype(
    [("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quaternion", "u1", 4)]
)

OPENGL = np.array([1, -1, -1], np.float32)  # Map axes to OpenGL axes, and back.
# Factors from the quaternion of a rotation R to the quaternion of F R F, with F = diag(OPENGL).
OPENGL_QUAT = np.array([1, 1, -1, -1], np.float32)


def write_ply(path: Path, rows: np.ndarray) -> None:
    """Write Gaussian rows [N, 16] (see `gaussians.rows`) as PLY.

    Means are in meters, scales are logarithms of meters, and quaternions (wxyz) have length one.
    The opacity is a logit, and the color is the spherical-harmonics coefficient of degree 0.
    """
    table = np.zeros((len(rows), len(PROPERTIES)), "<f4")
    for name, column in COLUMNS.items():
        table[:, PROPERTIES.index(name)] = rows[:, column]
    table[:, 6:9] = harmonics(rows[:, 11:14])
    lengths = np.linalg.norm(table[:, 13:17], axis=1, keepdims=True)
    table[:, 13:17] /= np.where(lengths > 0, lengths, 1)
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [f"property float {name}" for name in PROPERTIES] + ["end_header", ""]
    with path.open("wb") as file:
        file.write("\n".join(header).encode())
        file.write(table.tobytes())


def read_ply(path: Path) -> np.ndarray:
    """Read Gaussians from a PLY file of any program.

    The properties may be in any order and of any type, and the file may be text or binary. Normals
    and other properties and elements are ignored. View-dependent color (`f_rest_*`) is ignored with
    a warning.

    Returns:
        Gaussian rows [N, 16] float32 (see `gaussians.rows`).

    Raises:
        DataError: The file cannot be read, is cut off or too long, lacks a property, or holds NaN,
            infinity or a quaternion of length zero.
    """
    try:
        with path.open("rb") as file:
            header = _read_header(path, file)
            vertices = _read_vertices(path, header, file.read())
    except OSError as error:
        raise DataError(
            f"{path} cannot be read: {error.strerror}. Give an existing, readable PLY file."
        ) from error
    if any(name.startswith("f_rest_") for name in header.properties):
        log.warning(
            "%s: view-dependent color (f_rest_*) is not supported and is ignored; no action "
            "needed.",
            path,
        )
    return _rows(path, vertices)


def harmonics(colors: np.ndarray) -> np.ndarray:
    """Convert RGB [N, 3], 0..1, to spherical-harmonics coefficients of degree 0, [N, 3]."""
    return (colors - 0.5) / SH_C0


# --- reading --------------------------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class _Header:
    byte_order: str  # Byte order of NumPy; empty for text.
    count: int
    properties: dict[str, str]  # NumPy type of each property of a vertex, in file order.
    is_last: bool  # The vertices are the last element.


def _read_header(path: Path, file: BinaryIO) -> _Header:
    byte_order, elements = None, {}
    for words in _header_lines(path, file):
        match words:
            case ["format", name, _] if name in FORMATS:
                byte_order = FORMATS[name]
            case ["element", name, count] if count.isdecimal():
                elements[name] = (int(count), {})
            case ["property", kind, name] if kind in TYPES and elements:
                elements[list(elements)[-1]][1][name] = TYPES[kind]
            case ["property", "list", _, _, _] if elements and list(elements)[-1] != "vertex":
                pass
            case _:
                raise DataError(
                    f"{path} has an unknown line {' '.join(words)!r} in its header. {PLY_ADVICE}"
                )
    if byte_order is None:
        raise DataError(
            f"{path} has no line `format` in its header, so it is not a PLY file. {PLY_ADVICE}"
        )
    if next(iter(elements), None) != "vertex":
        raise DataError(
            f"{path} is not a map of Gaussians: its first element is not `vertex`. {PLY_ADVICE}"
        )
    return _Header(byte_order, *elements["vertex"], is_last=len(elements) == 1)


def _header_lines(path: Path, file: BinaryIO) -> Iterator[list[str]]:
    """Yield the words of each line between `ply` and `end_header`, without comments."""
    if file.readline(MAX_LINE).rstrip() != b"ply":
        raise DataError(f"{path} is not a PLY file: it does not start with `ply`. {PLY_ADVICE}")
    while line := file.readline(MAX_LINE):
        words = line.decode("ascii", "replace").split()
        if words == ["end_header"]:
            return
        if words and words[0] not in ("comment", "obj_info"):
            yield words
    raise DataError(
        f"{path} is cut off: its header has no line `end_header`. Copy or export it again."
    )


def _read_vertices(path: Path, header: _Header, body: bytes) -> dict[str, np.ndarray]:
    missing = [name for name in COLUMNS if name not in header.properties]
    if missing:
        raise DataError(
            f"{path} has no property {missing[0]}, so it is not a map of Gaussians. {PLY_ADVICE}"
        )
    if header.byte_order:
        return _binary_vertices(path, header, body)
    return _text_vertices(path, header, body)


def _binary_vertices(path: Path, header: _Header, body: bytes) -> dict[str, np.ndarray]:
    dtype = np.dtype([(n, header.byte_order + kind) for n, kind in header.properties.items()])
    _require_size(path, header, len(body), dtype.itemsize, "bytes")
    table = np.frombuffer(body, dtype, header.count)
    return {name: table[name] for name in COLUMNS}


def _text_vertices(path: Path, header: _Header, body: bytes) -> dict[str, np.ndarray]:
    words, width = body.split(), len(header.properties)
    _require_size(path, header, len(words), width, "numbers")
    try:
        table = np.array(words[: header.count * width], float).reshape(header.count, width)
    except ValueError as error:
        raise DataError(
            f"{path} contains text that is not a number: {error}. Export it again."
        ) from error
    return {name: table[:, list(header.properties).index(name)] for name in COLUMNS}


def _require_size(path: Path, header: _Header, found: int, each: int, unit: str) -> None:
    expected = header.count * each
    if found < expected:
        raise DataError(
            f"{path} is cut off: {header.count} Gaussians need {expected} {unit}, but the file "
            f"has {found}. Copy or export it again."
        )
    if found > expected and header.is_last:
        raise DataError(
            f"{path} has {found - expected} {unit} more than the {header.count} Gaussians that its "
            "header announces. Header and content do not match. Export the file again."
        )


def _rows(path: Path, vertices: dict[str, np.ndarray]) -> np.ndarray:
    rows = aligned_rows(len(vertices["x"]))
    with np.errstate(over="ignore"):  # Overflow is rejected below.
        for name, column in COLUMNS.items():
            rows[:, column] = vertices[name]
    rows[:, 11:14] = rows[:, 11:14] * np.float32(SH_C0) + np.float32(0.5)
    bad = ~np.isfinite(rows).all(axis=1) | ~rows[:, 6:10].any(axis=1)
    if bad.any():
        raise DataError(
            f"{path}: {bad.sum()} of {len(rows)} Gaussians contain NaN, infinity or a quaternion "
            f"of length zero; the first has index {np.argmax(bad)}. Export the file again without "
            "them."
        )
    return rows


def write_splat(path: Path, rows: np.ndarray) -> None:
    """Write Gaussian rows [N, 16] (see `gaussians.rows`) as .splat; colors are clipped to 0..1."""
    scales, opacities = np.exp(rows[:, 3:6]), 1 / (1 + np.exp(-rows[:, 10:11]))
    quats = rows[:, 6:10] / np.linalg.norm(rows[:, 6:10], axis=1, keepdims=True)
    splats = np.zeros(len(rows), SPLAT)
    splats["mean"], splats["scale"] = rows[:, 0:3], scales
    splats["rgba"] = _bytes(255 * np.hstack([rows[:, 11:14], opacities]))
    splats["quaternion"] = _bytes(128 + 128 * quats)
    # Viewers draw while they load, so Gaussians with a large weight come first.
    weights = opacities[:, 0] * scales.prod(axis=1)
    path.write_bytes(splats[np.argsort(-weights, kind="stable")].tobytes())


def _bytes(values: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def write_spz(path: Path, rows: np.ndarray) -> None:
    """Write Gaussian rows [N, 16] (see `gaussians.rows`) as .spz.

    Raises:
        ConfigError: The optional package gsply is not installed.
    """
    try:
        import gsply  # An optional package, whose import takes a third of a second.
    except ImportError as error:
        raise ConfigError(
            f"writing .spz needs gsply ({error}). Install it by {install_command('viewer')}."
        ) from error
    gaussians = gsply.GSData.from_arrays(
        means=rows[:, 0:3] * OPENGL,
        scales=np.ascontiguousarray(rows[:, 3:6]),  # Logarithms, as in a PLY.
        quats=rows[:, 6:10] * OPENGL_QUAT,  # wxyz
        opacities=np.ascontiguousarray(rows[:, 10]),  # Logits.
        sh0=harmonics(rows[:, 11:14]),
        shN=None,
        format="ply",
    )
    gsply.write_spz(path, gaussians, version=3)  # The version that every reader supports.
