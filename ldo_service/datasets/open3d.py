"""Sequences in the layout of Open3D's reconstruction system, in which Redwood is published too.

color/*.jpg depth/*.png    numbered images of one size; depth in millimeters, registered to color
camera_intrinsic.json      or intrinsic.json: {"width", "height", "intrinsic_matrix"}, the last with
                           9 numbers column by column

Names of Redwood have the stamp after the number: 0000001-000000033333.jpg. It is not read: the
frames are taken as 30 Hz. The layout has no ground truth beside the images, thus `truth` is None.
"""

from pathlib import Path

from ldo_service.errors import DataError
from ldo_service.geometry import Camera, RawFrame, Trajectory
from ldo_service.geometry.sequence import Sequence

from .files import name_of, numbered, pair_by_number, pinhole, read_json
from .images import read_color, read_depth

INTRINSICS = ("camera_intrinsic.json", "intrinsic.json")
DEPTH_SCALE = 1000.0  # Units per meter; the default of Open3D.


class Open3dSequence(Sequence):
    """Sequence of Open3D: frames with both color and depth, in the order of their numbers."""

    def __init__(self, folder: Path) -> None:
        """Open the sequence of a folder."""
        self._files = pair_by_number(
            numbered(folder / "color", r"(\d+)(?:-\d+)?\.(?:jpg|jpeg|png)"),
            numbered(folder / "depth", r"(\d+)(?:-\d+)?\.png"),
            folder,
        )
        path = next(folder / name for name in INTRINSICS if (folder / name).is_file())
        super().__init__(name_of(folder), _camera(path), self._files.stamps_ns)

    @staticmethod
    def matches(folder: Path) -> bool:
        """Return whether a folder has this layout."""
        return (folder / "color").is_dir() and any((folder / name).is_file() for name in INTRINSICS)

    def read(self, index: int) -> RawFrame:
        """Return a frame; see `Sequence.read`."""
        color, depth = read_color(self._files.color[index]), read_depth(self._files.depth[index])
        stamp_ns = int(self.stamps_ns[index])
        return RawFrame(index, stamp_ns, color, depth, DEPTH_SCALE, self.raw_camera)

    def truth(self) -> Trajectory | None:
        """Return None; the layout has no ground truth."""
        return None


def _camera(path: Path) -> Camera:
    fields = read_json(path)
    K = fields.get("intrinsic_matrix")
    if not isinstance(K, list) or len(K) != 9:
        raise DataError(f'{path}: expected 9 numbers under "intrinsic_matrix", column by column.')
    values = {**fields, "fx": K[0], "fy": K[4], "cx": K[6], "cy": K[7], "distortion": []}
    return pinhole(values, "width", "height", path)
