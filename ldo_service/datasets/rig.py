"""Colour and depth cameras of one sensor, and what to do about their difference."""

from dataclasses import dataclass, field, replace

import numpy as np

from ldo_service.errors import ConfigError
from ldo_service.geometry import Camera, se3
from ldo_service.geometry.registration import register_depth

from .files import is_rigid


@dataclass(frozen=True, slots=True, eq=False)
class Rig:
    """A colour and a depth camera; T_color_depth [4, 4] in metres."""

    color_camera: Camera
    depth_camera: Camera
    T_color_depth: np.ndarray = field(default_factory=lambda: np.eye(4))

    @property
    def is_one_view(self) -> bool:
        """Whether both look from one point in one direction, to 0.1 mm and 0.1 mrad."""
        return bool(np.linalg.norm(se3.log(self.T_color_depth)) < 1e-4)

    def register(self, depth_m: np.ndarray) -> np.ndarray:
        """Depth [Hd, Wd] in metres brought to the colour camera: [Hc, Wc] float32."""
        return register_depth(depth_m, self.depth_camera, self.color_camera, self.T_color_depth)

    def T_world_color(self, T_world_depth: np.ndarray) -> np.ndarray:
        """Poses [..., 4, 4] of the colour camera from those of the depth camera."""
        return T_world_depth @ se3.inverse(self.T_color_depth)


@dataclass(frozen=True, slots=True, eq=False)
class SequenceOptions:
    """How to read layouts whose depth is not registered to colour: ScanNet and 7-Scenes.

    Raises ConfigError for a T_color_depth that is not rigid.
    """

    register_depth: bool = False  # bring depth to the colour camera, at the size of colour
    color_camera: Camera | None = None  # None: as the files say, else as the layout documents
    depth_camera: Camera | None = None
    T_color_depth: np.ndarray | None = None  # [4, 4], metres

    def __post_init__(self) -> None:
        if self.T_color_depth is not None and not is_rigid(self.T_color_depth):
            raise ConfigError(
                f"T_color_depth is {self.T_color_depth.tolist()}, expected a rigid transform "
                "[4, 4] from depth to colour coordinates in metres."
            )

    @property
    def is_default(self) -> bool:
        return not self.register_depth and not self._given()

    def over(self, rig: Rig) -> Rig:
        """`rig` with what is given here instead."""
        return replace(rig, **self._given())

    def _given(self) -> dict[str, Camera | np.ndarray]:
        names = ("color_camera", "depth_camera", "T_color_depth")
        values = {name: getattr(self, name) for name in names}
        return {name: value for name, value in values.items() if value is not None}
