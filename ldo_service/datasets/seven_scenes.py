"""Sequences in the layout of 7-Scenes (Shotton et al., CVPR 2013), one `seq-XX` folder each.

frame-000000.color.png            8 bits; also .jpg
frame-000000.depth.png            millimeters; 0 and 65535 where not measured
frame-000000.pose.txt             optional: 4x4 depth camera to world by rows
camera-intrinsics.txt             optional, here or one folder up: 3x3 of the depth camera

The files are unregistered images of a Kinect: color and depth come from cameras 2.5 cm apart with
different focal lengths. By default, frames are read as they are, with the intrinsics of the depth
camera for both images. Color and depth then disagree by up to about thirty pixels.
`SequenceOptions.register_depth` registers depth to the color camera instead and transforms the
poses accordingly. The published calibration covers the depth camera only: fx = fy = 585 px,
cx = 320 px and cy = 240 px. The other values of the constant `RIG` are estimates, which
`SequenceOptions` can replace.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from ldo_service.geometry import Camera, RawFrame, Trajectory
from ldo_service.geometry.sequence import Sequence

from .files import name_of, numbered, pair_by_number, read_intrinsics, read_trajectory
from .images import first_size, read_color, read_depth
from .rig import Rig, SequenceOptions

DEPTH_SCALE = 1000.0  # Units per meter.
NOT_MEASURED = 65535  # Depth value that means unknown, as 0 does; from the data set's page.

# The calibration of the depth camera is that of the data set's page. The color camera has the
# Kinect's nominal focal length of 525 px, which Brachmann et al. (ICCV 2021) also use for
# 7-Scenes. The baseline comes from two published calibrations of other Kinects (25.4 mm, ROS
# kinect_calibration; 25.6 mm, LIRIS human activities data set). The calibrations agree along x,
# and have no common offset above 2.2 mm along y and z. Their rotations are not used, because each
# rotation fits only the principal points of its own calibration. The rotation here is the
# identity, and the principal point of the color camera is at row 238. With these values, edges of
# depth lie within a pixel of edges of color in the sequence RedKitchen.
DEPTH_CAMERA = Camera(640, 480, 585.0, 585.0, 320.0, 240.0)
COLOR_CAMERA = Camera(640, 480, 525.0, 525.0, 320.0, 238.0)
T_COLOR_DEPTH = np.array([[1.0, 0, 0, -0.0254], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
T_COLOR_DEPTH.flags.writeable = False
RIG = Rig(COLOR_CAMERA, DEPTH_CAMERA, T_COLOR_DEPTH)


class SevenScenesSequence(Sequence):
    """Sequence of 7-Scenes: frames with both color and depth, in the order of their numbers."""

    def __init__(self, folder: Path, options: SequenceOptions) -> None:
        """Open the sequence of a folder."""
        self._files = pair_by_number(
            numbered(folder, r"frame-(\d+)\.color\.(?:png|jpg|jpeg)"),
            numbered(folder, r"frame-(\d+)\.depth\.png"),
            folder,
        )
        self._rig = options.over(_rig(folder, self._files.depth))
        self._is_registering = options.register_depth
        camera = self._rig.color_camera if options.register_depth else self._rig.depth_camera
        super().__init__(name_of(folder), camera, self._files.stamps_ns)
        self.registration = "reader" if self._is_registering else "none"

    def read(self, index: int) -> RawFrame:
        """Return a frame; see `Sequence.read`."""
        color = read_color(self._files.color[index])
        depth, depth_scale = read_depth(self._files.depth[index]), DEPTH_SCALE
        depth[depth == NOT_MEASURED] = 0
        if self._is_registering:
            depth, depth_scale = self._rig.register(depth.astype(np.float32) / DEPTH_SCALE), 1.0
        stamp_ns = int(self.stamps_ns[index])
        return RawFrame(index, stamp_ns, color, depth, depth_scale, self.raw_camera)

    def truth(self) -> Trajectory | None:
        """Return the ground-truth trajectory, or None if there are no poses.

        If depth is registered to the color camera, the poses are those of the color camera, else
        those of the depth camera.
        """
        paths = [
            path.with_name(path.name.split(".")[0] + ".pose.txt") for path in self._files.depth
        ]
        depth = read_trajectory(self.stamps_ns, paths)
        if depth is None or not self._is_registering:
            return depth
        return replace(depth, T_world_camera=self._rig.T_world_color(depth.T_world_camera))


def _rig(folder: Path, depth_files: list[Path]) -> Rig:
    candidates = [parent / "camera-intrinsics.txt" for parent in (folder, folder.resolve().parent)]
    path = next((path for path in candidates if path.is_file()), None)
    if path is None:
        return RIG
    return replace(RIG, depth_camera=read_intrinsics(path, 3, first_size(depth_files)))
