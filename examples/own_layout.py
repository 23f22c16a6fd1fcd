"""Example of a separate package that adds a layout of recordings to `ldo run`.

The recording is a .npz file with four arrays: color [N, H, W, 3] uint8, depth_mm [N, H, W] uint16,
stamps_ns [N] int64 and camera [6]. The array camera has width, height, fx, fy, cx and cy. The
package registers LAYOUT in its pyproject.toml:

    [project.entry-points."ldo.sequences"]
    numpy_file = "own_layout:LAYOUT"
"""

from pathlib import Path

import numpy as np

from ldo_service import Camera, Trajectory
from ldo_service.datasets import Layout, RawFrame, Sequence, SequenceOptions
from ldo_service.errors import DataError

NAMES = ("color", "depth_mm", "stamps_ns", "camera")


class NumpySequence(Sequence):
    """Frames of a file .npz."""

    def __init__(self, path: Path, _options: SequenceOptions) -> None:
        try:
            with np.load(path, allow_pickle=False) as file:
                self._color, self._depth_mm, stamps_ns, camera = (file[name] for name in NAMES)
        except (OSError, ValueError, KeyError) as error:
            raise DataError(
                f"{path} cannot be read ({error}). Give a .npz with arrays {', '.join(NAMES)}."
            ) from error
        width, height, fx, fy, cx, cy = camera.tolist()
        camera = Camera(int(width), int(height), fx, fy, cx, cy)
        super().__init__(path.stem, camera, stamps_ns)

    def read(self, index: int) -> RawFrame:
        """Return a frame; see `Sequence.read` for the errors."""
        images = self._color[index], self._depth_mm[index]
        return RawFrame(index, int(self.stamps_ns[index]), *images, 1000.0, self.raw_camera)

    def truth(self) -> Trajectory | None:
        """Return None, because the file has no ground truth."""
        return None


LAYOUT = Layout("NumPy", "a file .npz", lambda path: path.suffix == ".npz", NumpySequence)
