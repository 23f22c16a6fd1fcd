"""The .spz file: Gaussians quantised and compressed, about a tenth of a PLY.

Means are fixed point (0.24 mm, up to 2 km), log scales in steps of 1/16, opacity and colour bytes,
quaternions good to about a tenth of a degree. Format: https://github.com/nianticlabs/spz

An .spz file has the axes of OpenGL: x right, y up, z back. `gsply.write_spz` does not turn what it
is given, so the map (x right, y down, z forward) is turned here, as Niantic's library turns RDF to
RUB. (`GSData.save` would write a PLY, whatever the name of the file.)
"""

from pathlib import Path

import numpy as np

from ldo_service.errors import ConfigError

from .ply import harmonics

OPENGL = np.array([1, -1, -1], np.float32)  # axes of OpenGL in those of the map, and back
OPENGL_QUAT = np.array([1, 1, -1, -1], np.float32)  # the same mirroring F of a rotation: F R F


def write_spz(path: Path, rows: np.ndarray) -> None:
    """Write Gaussian rows [N, 16] (see `gaussians.model`). Raises ConfigError without gsply."""
    try:
        import gsply  # takes a third of a second, and is an extra
    except ImportError as error:
        raise ConfigError(
            f"writing .spz needs gsply ({error}). `pip install 'ldo-slam[viewer]'` brings it."
        ) from error
    gaussians = gsply.GSData.from_arrays(
        means=rows[:, 0:3] * OPENGL,
        scales=np.ascontiguousarray(rows[:, 3:6]),  # logarithms, as in a PLY
        quats=rows[:, 6:10] * OPENGL_QUAT,  # wxyz
        opacities=np.ascontiguousarray(rows[:, 10]),  # logits
        sh0=harmonics(rows[:, 11:14]),
        shN=None,
        format="ply",
    )
    gsply.write_spz(path, gaussians, version=3)  # the container that every reader knows
