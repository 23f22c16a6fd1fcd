"""SPZ files, checked with a parser of the format and with gsply."""

import gzip
import struct
import sys
from pathlib import Path

import numpy as np
import pytest

from ldo_service.errors import ConfigError
from ldo_service.gaussians.file_formats import write_spz
from ldo_service.geometry import se3

R_OPENGL = np.diag([1.0, -1.0, -1.0])  # Rotation of x right, y down, z forward to OpenGL.


def covariances(log_scales: np.ndarray, quats: np.ndarray) -> np.ndarray:
    RS = se3.rotation(quats.astype(float)) * np.exp(log_scales.astype(float))[:, None, :]
    return RS @ RS.swapaxes(1, 2)


def angles_deg(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    R, S = se3.rotation(p.astype(float)), se3.rotation(q.astype(float))
    return np.rad2deg(np.arccos(np.clip((np.einsum("nij,nij->n", R, S) - 1) / 2, -1, 1)))


def smallest_three(packed: int) -> list[float]:
    """Return the quaternion wxyz of a packed one.

    Two bits give the index of the largest of xyzw; the others have a sign and nine bits each.
    """
    largest, others = packed >> 30, [packed >> shift & 1023 for shift in (20, 10, 0)]
    values = [(o & 511) / 511 / 2**0.5 * (-1 if o & 512 else 1) for o in others]
    values.insert(largest, max(0.0, 1 - sum(v * v for v in values)) ** 0.5)
    return [values[3], *values[:3]]


def parse(path: Path) -> dict[str, np.ndarray]:
    file = gzip.decompress(path.read_bytes())
    magic, version, n, degree, fraction_bits = struct.unpack("<4sIIBB", file[:14])
    assert (magic, version, degree) == (b"NGSP", 3, 0)
    sections = np.split(np.frombuffer(file, "u1", offset=16), np.cumsum([9 * n, n, 3 * n, 3 * n]))
    fixed = np.zeros((3 * n, 4), "u1")
    fixed[:, 1:] = sections[0].reshape(-1, 3)
    quats = [smallest_three(packed) for packed in sections[4].view("<u4").tolist()]
    return {
        "means": (fixed.view("<i4").reshape(n, 3) >> 8) / 2**fraction_bits,
        "opacities": sections[1] / 255,
        "colors": 0.5 + 0.28209479177387814 * (sections[2].reshape(n, 3) / 255 - 0.5) / 0.15,
        "log_scales": sections[3].reshape(n, 3) / 16 - 10,
        "quats": np.array(quats),
    }


@pytest.fixture
def spz(tmp_path: Path, some_rows: np.ndarray) -> Path:
    pytest.importorskip("gsply", reason="pip install -e '.[viewer]'")
    write_spz(tmp_path / "map.spz", some_rows)
    return tmp_path / "map.spz"


def test_every_attribute_is_restored_within_quantization(spz: Path, some_rows: np.ndarray) -> None:
    read = parse(spz)
    np.testing.assert_allclose(read["means"] @ R_OPENGL, some_rows[:, 0:3], atol=0.5 / 4096 + 1e-6)
    np.testing.assert_allclose(read["log_scales"], some_rows[:, 3:6], atol=0.5 / 16 + 1e-6)
    opacities = 1 / (1 + np.exp(-some_rows[:, 10]))
    np.testing.assert_allclose(read["opacities"], opacities, atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(read["colors"], some_rows[:, 11:14], atol=0.004)
    assert angles_deg(read["quats"] * [1, 1, -1, -1], some_rows[:, 6:10]).max() < 0.3


def test_covariances_are_rotated_to_opengl_axes(spz: Path, some_rows: np.ndarray) -> None:
    """Covariances in OpenGL axes are the rotated ones of the map, up to quantization."""
    read = parse(spz)
    expected = R_OPENGL @ covariances(read["log_scales"], some_rows[:, 6:10]) @ R_OPENGL
    actual = covariances(read["log_scales"], read["quats"])
    error = np.linalg.norm(actual - expected, axis=(1, 2)) / np.linalg.norm(expected, axis=(1, 2))
    assert error.max() < 0.01


def test_gsply_matches_the_parser(spz: Path) -> None:
    gsply, parsed = pytest.importorskip("gsply"), parse(spz)
    data = gsply.read_spz(spz)
    np.testing.assert_allclose(data.means, parsed["means"], atol=1e-6)
    np.testing.assert_allclose(data.scales, parsed["log_scales"], atol=1e-6)
    np.testing.assert_allclose(gsply.sh2rgb(data.sh0), parsed["colors"], atol=1e-5)
    np.testing.assert_allclose(gsply.sigmoid(data.opacities), parsed["opacities"], atol=1e-5)
    assert angles_deg(data.quats, parsed["quats"]).max() < 0.05


def test_missing_gsply_raises_with_install_command(
    tmp_path: Path, some_rows: np.ndarray, monkeypatch
) -> None:
    monkeypatch.setitem(sys.modules, "gsply", None)
    with pytest.raises(ConfigError, match=r"pip install -e '\.\[viewer\]'"):
        write_spz(tmp_path / "map.spz", some_rows)
