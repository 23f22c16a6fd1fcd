"""Sequences in the layout of Open3D's reconstruction system, which the Redwood data set also uses.

color/*.jpg depth/*.png    numbered images of one size; depth in millimeters, registered to color.
                           Redwood names the first folder image/ or rgb/
camera_intrinsic.json      or intrinsic.json: an object with the keys width, height (pixels) and
                           intrinsic_matrix (9 numbers, column by column). Redwood has no such file;
                           its camera is REDWOOD_CAMERA

File names of Redwood have a stamp after the number: 0000001-000000033333.jpg. This stamp is not
used; the image with number k gets the stamp k / 30 s. The layout has no ground truth, so `truth`
returns None.
"""

import logging
import re
from pathlib import Path

from ldo_service.errors import DataError
from ldo_service.geometry import Camera, RawFrame, Trajectory
from ldo_service.geometry.sequence import Sequence

from .files import name_of, numbered, pair_by_number, pinhole, read_json
from .images import first_size, read_color, read_depth

log = logging.getLogger(__name__)

COLOR_FOLDERS = ("color", "image", "rgb")
INTRINSICS = ("camera_intrinsic.json", "intrinsic.json")
IMAGE_NAME = r"(\d+)(?:-\d+)?"  # Number, followed by the stamp in file names of Redwood.
DEPTH_SCALE = 1000.0  # Units per meter; the default of Open3D.
# Camera of Redwood, whose folders have no intrinsics: the PrimeSense that Open3D assumes too.
REDWOOD_CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)


class Open3dSequence(Sequence):
    """Sequence of Open3D: frames with both color and depth, in the order of their numbers."""

    def __init__(self, folder: Path) -> None:
        """Open the sequence of a folder."""
        color = next(folder / name for name in COLOR_FOLDERS if (folder / name).is_dir())
        self._files = pair_by_number(
            numbered(color, rf"{IMAGE_NAME}\.(?:jpg|jpeg|png)"),
            numbered(folder / "depth", rf"{IMAGE_NAME}\.png"),
            folder,
        )
        paths = [folder / name for name in INTRINSICS if (folder / name).is_file()]
        camera = _camera(paths[0]) if paths else _redwood_camera(folder, self._files.color)
        super().__init__(name_of(folder), camera, self._files.stamps_ns)

    @staticmethod
    def matches(folder: Path) -> bool:
        """Return whether a folder has this layout."""
        has_color = any((folder / name).is_dir() for name in COLOR_FOLDERS)
        if has_color and any((folder / name).is_file() for name in INTRINSICS):
            return True
        return (folder / "depth").is_dir() and _has_redwood_names(folder)

    def read(self, index: int) -> RawFrame:
        """Return a frame; see `Sequence.read`."""
        color, depth = read_color(self._files.color[index]), read_depth(self._files.depth[index])
        stamp_ns = int(self.stamps_ns[index])
        return RawFrame(index, stamp_ns, color, depth, DEPTH_SCALE, self.raw_camera)

    def truth(self) -> Trajectory | None:
        """Return None; the layout has no ground truth."""
        return None


def _has_redwood_names(folder: Path) -> bool:
    """Return whether there is a folder image/, or a folder rgb/ whose images have a stamp."""
    stamped = (path.name for path in folder.glob("rgb/*-*"))
    return (folder / "image").is_dir() or any(
        re.fullmatch(r"\d+-\d+\.(jpg|png)", name) for name in stamped
    )


def _redwood_camera(folder: Path, color: list[Path]) -> Camera:
    """Return the camera of Redwood, if the images have its size.

    Raises:
        DataError: The images have another size.
    """
    width, height = first_size(color)
    if (width, height) != (REDWOOD_CAMERA.width, REDWOOD_CAMERA.height):
        raise DataError(
            f"{folder} has no camera_intrinsic.json, and its images have {width}x{height} pixels, "
            "not 640x480 like those of Redwood. Create camera_intrinsic.json with the content "
            f'{{"width": {width}, "height": {height}, "intrinsic_matrix": [fx, 0, 0, 0, fy, 0, cx, '
            "cy, 1]}; the matrix is stored column by column."
        )
    log.info("%s has no intrinsics; those of Redwood's PrimeSense are used.", folder)
    return REDWOOD_CAMERA


def _camera(path: Path) -> Camera:
    fields = read_json(path)
    K = fields.get("intrinsic_matrix")
    if not isinstance(K, list) or len(K) != 9:
        raise DataError(
            f'{path}: expected a list of 9 numbers under "intrinsic_matrix", the matrix column by '
            "column. Correct the file."
        )
    values = {**fields, "fx": K[0], "fy": K[4], "cx": K[6], "cy": K[7], "distortion": []}
    return pinhole(values, "width", "height", path)
