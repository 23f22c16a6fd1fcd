"""The .splat file of web viewers: 32 bytes per Gaussian, the weightiest first, no header.

    position 3 float32 | scale 3 float32, metres | RGBA 4 uint8 | quaternion wxyz 4 uint8

A byte of the quaternion is 128 (1 + q), so a rotation is good to about half a degree. Axes are
those of the map. Format: https://github.com/antimatter15/splat
"""

from pathlib import Path

import numpy as np

SPLAT = np.dtype(
    [("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quaternion", "u1", 4)]
)


def write_splat(path: Path, rows: np.ndarray) -> None:
    """Write Gaussian rows [N, 16] (see `gaussians.model`); colours beyond 0..1 are clipped."""
    scales, opacities = np.exp(rows[:, 3:6]), 1 / (1 + np.exp(-rows[:, 10:11]))
    quats = rows[:, 6:10] / np.linalg.norm(rows[:, 6:10], axis=1, keepdims=True)
    splats = np.zeros(len(rows), SPLAT)
    splats["mean"], splats["scale"] = rows[:, 0:3], scales
    splats["rgba"] = _bytes(255 * np.hstack([rows[:, 11:14], opacities]))
    splats["quaternion"] = _bytes(128 + 128 * quats)
    # Viewers draw while they load.
    weights = opacities[:, 0] * scales.prod(axis=1)
    path.write_bytes(splats[np.argsort(-weights, kind="stable")].tobytes())


def _bytes(values: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)
