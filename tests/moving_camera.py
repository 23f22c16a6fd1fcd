"""Frames of a hand-held camera in a room, with any timing of the shutter."""

import numpy as np

from ldo_service.calibration.shutter import ShutterTiming
from ldo_service.geometry import Camera, RgbdFrame, se3
from ldo_service.synthetic.handheld.motion import room_motion
from ldo_service.synthetic.path import LOOK_AROUND
from ldo_service.synthetic.ray_casting import RayCaster
from ldo_service.synthetic.room import furnished_room
from ldo_service.synthetic.room_render import Renderer

DURATION_S = 4.4
CAMERA = Camera(320, 240, 260.0, 260.0, 159.5, 119.5)


class MovingCamera:
    """Camera that looks around in a furnished room."""

    def __init__(self) -> None:
        self._room = furnished_room(0)
        self._renderer = Renderer(self._room)
        self._motion = room_motion(LOOK_AROUND, DURATION_S, 0)

    def pose(self, time_s: float) -> np.ndarray:
        """Return T_world_camera [4, 4]."""
        return self._motion.poses(np.array([time_s]))[0]

    def velocity(self, time_s: float) -> np.ndarray:
        """Return the velocity [6] in the camera frame: rad/s, then m/s."""
        before, after = self._motion.poses(np.array([time_s - 5e-4, time_s + 5e-4]))
        return se3.log(se3.inverse(before) @ after) / 1e-3

    def frame(self, time_s: float, timing: ShutterTiming, index: int = 0) -> RgbdFrame:
        """Return the frame whose middle color row is recorded at a time."""
        poses = self._poses_of_rows(time_s, timing.readout_s)
        light = self._renderer.render(CAMERA, poses).light
        later = self._poses_of_rows(time_s + timing.depth_delay_s, timing.depth_readout_s)
        color = np.floor(np.clip(light, 0.0, 1.0) * 255 + 0.5).astype(np.uint8)
        return RgbdFrame(
            np.maximum(color, 1),  # Black pixels are invalid.
            self._depth_m(later),
            CAMERA,
            round(1e9 * time_s),
            index,
        )

    def depth_m(self, T_world_depth: np.ndarray) -> np.ndarray:
        """Return the depth [H, W] that a camera at a pose [4, 4] measures."""
        return self._depth_m(np.broadcast_to(T_world_depth, (CAMERA.height, 4, 4)))

    def _depth_m(self, T_world_camera: np.ndarray) -> np.ndarray:
        """Return the depth [H, W] from a pose for each row, [H, 4, 4]."""
        v, u = np.divmod(np.arange(CAMERA.width * CAMERA.height), CAMERA.width)
        view = RayCaster(self._room.shell, self._room.furniture, CAMERA, T_world_camera)
        depth_m = view.cast(u, v).depth_m.astype(np.float32)
        return depth_m.reshape(CAMERA.height, CAMERA.width)

    def _poses_of_rows(self, time_s: float, readout_s: float) -> np.ndarray:
        """Return T_world_camera [H, 4, 4] of the rows, the middle one at a time."""
        rows = (np.arange(CAMERA.height) - (CAMERA.height - 1) / 2) / (CAMERA.height - 1)
        return self._motion.poses(time_s + rows * readout_s)
