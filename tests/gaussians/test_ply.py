"""PLY files, checked with plyfile and gsply."""

import logging
from pathlib import Path

import numpy as np
import pytest

from ldo_service.errors import DataError
from ldo_service.gaussians.file_formats import COLUMNS, PROPERTIES, SH_C0, read_ply, write_ply

plyfile = pytest.importorskip("plyfile", reason="pip install plyfile")


@pytest.fixture
def ply(tmp_path: Path, some_rows: np.ndarray) -> Path:
    write_ply(tmp_path / "map.ply", some_rows)
    return tmp_path / "map.ply"


def write_with_plyfile(
    path: Path, rows: np.ndarray, properties: list[tuple[str, str]], **options: object
) -> None:
    """Write Gaussians with properties (name, type) in the given order, using plyfile."""
    table = np.ones(len(rows), properties)
    for name, _ in properties:
        if name in COLUMNS:
            table[name] = rows[:, COLUMNS[name]]
        if name.startswith("f_dc_"):
            table[name] = (rows[:, COLUMNS[name]] - 0.5) / SH_C0
    plyfile.PlyData([plyfile.PlyElement.describe(table, "vertex")], **options).write(str(path))


def normalized(quats: np.ndarray) -> np.ndarray:
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


def test_every_attribute_is_restored(ply: Path, some_rows: np.ndarray) -> None:
    read = read_ply(ply)
    assert read.dtype == np.float32
    np.testing.assert_array_equal(read[:, [*range(6), 10]], some_rows[:, [*range(6), 10]])
    np.testing.assert_allclose(read[:, 6:10], normalized(some_rows[:, 6:10]), atol=2e-7)
    np.testing.assert_allclose(read[:, 11:], some_rows[:, 11:], atol=2e-7)


def test_empty_map_is_restored(tmp_path: Path) -> None:
    write_ply(tmp_path / "map.ply", np.zeros((0, 16), np.float32))
    assert read_ply(tmp_path / "map.ply").shape == (0, 16)


def test_plyfile_reads_the_3dgs_properties(ply: Path, some_rows: np.ndarray) -> None:
    vertices = plyfile.PlyData.read(str(ply))["vertex"]
    assert [prop.name for prop in vertices.properties] == list(PROPERTIES)
    np.testing.assert_array_equal(vertices["scale_1"], some_rows[:, 4])
    np.testing.assert_allclose(vertices["rot_0"], normalized(some_rows[:, 6:10])[:, 0], atol=2e-7)
    np.testing.assert_array_equal(vertices["opacity"], some_rows[:, 10])
    green = 0.5 + 0.28209479177387814 * vertices["f_dc_1"]
    np.testing.assert_allclose(green, some_rows[:, 12], atol=1e-6)


def test_gsply_reads_equal_gaussians(ply: Path, some_rows: np.ndarray) -> None:
    gsply = pytest.importorskip("gsply", reason="pip install -e '.[viewer]'")
    data = gsply.plyread(str(ply))
    np.testing.assert_array_equal(data.means, some_rows[:, 0:3])
    np.testing.assert_array_equal(data.scales, some_rows[:, 3:6])
    np.testing.assert_allclose(data.quats, normalized(some_rows[:, 6:10]), atol=2e-7)
    np.testing.assert_array_equal(data.opacities, some_rows[:, 10])
    np.testing.assert_allclose(gsply.sh2rgb(data.sh0), some_rows[:, 11:14], atol=1e-6)


@pytest.mark.parametrize(
    "options", [{"text": True}, {"byte_order": "<"}, {"byte_order": ">"}], ids=str
)
def test_files_of_other_programs_are_read(
    tmp_path: Path, some_rows: np.ndarray, options: dict, caplog
) -> None:
    properties = [(name, "f8") for name in reversed(COLUMNS)]
    properties[3:3] = [("red", "u1"), ("f_rest_0", "f4"), ("segment", "i2")]
    path = tmp_path / "other.ply"
    write_with_plyfile(path, some_rows, properties, comments=["by hand"], **options)
    with caplog.at_level(logging.WARNING):
        read = read_ply(path)
    assert "f_rest_" in caplog.text
    np.testing.assert_allclose(read, some_rows, rtol=1e-6, atol=2e-7)


def test_elements_after_the_gaussians_are_ignored(tmp_path: Path, some_rows: np.ndarray) -> None:
    write_with_plyfile(tmp_path / "a.ply", some_rows, [(name, "f4") for name in COLUMNS])
    vertices = plyfile.PlyData.read(str(tmp_path / "a.ply"))["vertex"]
    faces = np.array([([0, 1, 2],)], [("vertex_indices", "i4", (3,))])
    elements = [vertices, plyfile.PlyElement.describe(faces, "face")]
    plyfile.PlyData(elements).write(str(tmp_path / "b.ply"))
    np.testing.assert_allclose(read_ply(tmp_path / "b.ply"), some_rows, atol=2e-7)


def without(header: bytes, name: bytes) -> bytes:
    return header.replace(b"property float " + name + b"\n", b"")


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda b: b[:-1], "cut off"),
        (lambda b: b[: b.index(b"property")], "no line `end_header`"),
        (lambda b: b + b"\0", "do not match"),
        (lambda b: without(b, b"opacity"), "no property opacity"),
        (lambda b: without(b, b"nx"), "more than the 200 Gaussians"),
        (lambda b: b.replace(b"vertex 200", b"vertex 201"), "cut off"),
        (lambda b: b.replace(b"vertex 200", b"vertex 99999999999"), "cut off"),
        (lambda b: b.replace(b"vertex 200", b"vertex -20"), "vertex -20"),
        (lambda b: b.replace(b"vertex 200", b"camera 200"), "not `vertex`"),
        (lambda b: b.replace(b"binary_little_endian", b"zipped"), "format zipped"),
        (lambda b: b.replace(b"format", b"comment"), "no line `format`"),
        (lambda b: b.replace(b"float x", b"list uchar int x"), "property list"),
        (lambda b: b.replace(b"binary_little_endian", b"ascii"), "cut off"),
        (lambda b: b[:-4] + b"\0\0\xc0\x7f", "contain NaN"),
        (lambda b: b[:-16] + bytes(16), "length zero"),
        (lambda _: b"", "does not start"),
        (lambda _: bytes(range(256)) * 999, "does not start"),
    ],
)
def test_damaged_file_raises_with_its_path(ply: Path, damage, message: str) -> None:
    ply.write_bytes(damage(ply.read_bytes()))
    with pytest.raises(DataError, match=message) as caught:
        read_ply(ply)
    assert str(ply) in str(caught.value)


def test_text_between_numbers_raises(tmp_path: Path, some_rows: np.ndarray) -> None:
    path = tmp_path / "text.ply"
    write_with_plyfile(path, some_rows, [(name, "f4") for name in COLUMNS], text=True)
    path.write_text(path.read_text().rsplit(" ", 1)[0] + " zero\n")
    with pytest.raises(DataError, match="zero"):
        read_ply(path)


def test_missing_file_raises(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="cannot be read"):
        read_ply(tmp_path / "absent.ply")
