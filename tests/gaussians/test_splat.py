from pathlib import Path

import numpy as np

from ldo_service.gaussians.file_formats import write_splat
from ldo_service.geometry import se3


def parse(file: bytes) -> list[tuple]:
    """Return mean, scale, RGBA and quaternion wxyz of each Gaussian, as the format describes."""
    gaussians = []
    for start in range(0, len(file), 32):
        numbers = np.frombuffer(file, "<f4", 6, start)
        small = np.frombuffer(file, "u1", 8, start + 24).astype(float)
        gaussians.append((numbers[:3], numbers[3:], small[:4] / 255, (small[4:] - 128) / 128))
    return gaussians


def write_and_parse(folder: Path, rows: np.ndarray) -> tuple[np.ndarray, ...]:
    write_splat(folder / "map.splat", rows)
    file = (folder / "map.splat").read_bytes()
    assert len(file) == 32 * len(rows)
    means, scales, rgba, quats = map(np.array, zip(*parse(file), strict=True))
    return means, scales, rgba, quats


def by_weight(rows: np.ndarray) -> np.ndarray:
    weight = np.exp(rows[:, 3:6].astype(float).sum(axis=1)) / (1 + np.exp(-rows[:, 10]))
    return rows[np.argsort(-weight)]


def test_every_attribute_is_restored_within_quantization(
    tmp_path: Path, some_rows: np.ndarray
) -> None:
    means, scales, rgba, quats = write_and_parse(tmp_path, some_rows)
    rows = by_weight(some_rows)
    np.testing.assert_array_equal(means, rows[:, 0:3])
    np.testing.assert_allclose(scales, np.exp(rows[:, 3:6]), rtol=1e-6)
    np.testing.assert_allclose(rgba[:, :3], rows[:, 11:14], atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(rgba[:, 3], 1 / (1 + np.exp(-rows[:, 10])), atol=0.5 / 255 + 1e-6)
    R_expected, R = se3.rotation(rows[:, 6:10].astype(float)), se3.rotation(quats)
    angles = np.arccos((np.einsum("nij,nij->n", R_expected, R) - 1) / 2)
    assert np.rad2deg(angles).max() < 1.0


def test_colors_out_of_range_are_clipped(tmp_path: Path, some_rows: np.ndarray) -> None:
    some_rows[:, 11:14] = [-0.2, 0.5, 1.3]
    _, _, rgba, _ = write_and_parse(tmp_path, some_rows)
    np.testing.assert_allclose(rgba[:, :3], np.tile([0, 0.5, 1], (200, 1)), atol=1 / 255)
