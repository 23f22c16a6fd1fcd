"""The PLY file of 3D Gaussian splatting, as its viewers read it."""

from pathlib import Path

import numpy as np

SH_C0 = 0.28209479177387814  # of the constant spherical harmonic, 1 / (2 sqrt(pi))
PROPERTIES = (
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)


def write_ply(path: Path, rows: np.ndarray) -> None:
    """Write Gaussian rows [N, 16] (see `gaussians.model`): means in metres, log scales,
    quaternion wxyz, logit of the opacity, colour as the constant spherical harmonic."""
    table = np.zeros((len(rows), len(PROPERTIES)), "<f4")
    table[:, 0:3] = rows[:, 0:3]
    table[:, 6:9] = (rows[:, 11:14] - 0.5) / SH_C0
    table[:, 9] = rows[:, 10]
    table[:, 10:13] = rows[:, 3:6]
    table[:, 13:17] = rows[:, 6:10]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [f"property float {name}" for name in PROPERTIES] + ["end_header", ""]
    with path.open("wb") as file:
        file.write("\n".join(header).encode())
        file.write(table.tobytes())
