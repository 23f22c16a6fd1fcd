"""Color and depth cameras of a sensor, and registration between them."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from ldo_service.errors import ConfigError
from ldo_service.geometry import Camera, se3
from ldo_service.geometry.registration import register_depth, resample_color

from .files import is_rigid


@dataclass(frozen=True, slots=True, eq=False)
class Rig:
    """Color and depth camera of a sensor."""

    color_camera: Camera
    depth_camera: Camera
    # Transform from depth to color coordinates, [4, 4], meters.
    T_color_depth: np.ndarray = field(default_factory=lambda: np.eye(4))

    @property
    def is_one_view(self) -> bool:
        """True if both cameras have equal center and orientation, within 0.1 mm and 0.1 mrad."""
        return bool(np.linalg.norm(se3.log(self.T_color_depth)) < 1e-4)

    def register(self, depth_m: np.ndarray) -> np.ndarray:
        """Register a depth image to the color camera.

        Args:
            depth_m: Depth in the depth camera, [Hd, Wd], meters; 0 where not measured.

        Returns:
            Depth in the color camera, [Hc, Wc] float32, meters; 0 where unknown.
        """
        return register_depth(depth_m, self.depth_camera, self.color_camera, self.T_color_depth)

    def on_one_grid(
        self, color: np.ndarray, depth: np.ndarray, depth_scale: float, is_registering: bool
    ) -> tuple[np.ndarray, np.ndarray, float]:
        """Bring color and depth to one pixel grid.

        Args:
            color: Color image, [Hc, Wc, 3] uint8 RGB.
            depth: Depth, [Hd, Wd] uint16.
            depth_scale: Units of depth per meter.
            is_registering: True registers depth to the color camera. False resamples color to the
                depth camera, which must have the same center and orientation.

        Returns:
            Color [H, W, 3], depth [H, W], and the units of depth per meter.
        """
        if is_registering:
            return color, self.register(depth.astype(np.float32) / depth_scale), 1.0
        color, is_seen = resample_color(color, self.color_camera, self.depth_camera)
        if depth.shape == is_seen.shape:  # Otherwise RawFrame raises the error.
            depth = np.where(is_seen, depth, np.uint16(0))
        return color, depth, depth_scale

    def T_world_color(self, T_world_depth: np.ndarray) -> np.ndarray:
        """Return the poses [..., 4, 4] of the color camera from those of the depth camera."""
        return T_world_depth @ se3.inverse(self.T_color_depth)


@dataclass(frozen=True, slots=True, eq=False)
class SequenceOptions:
    """Options for layouts with unregistered depth (ScanNet, 7-Scenes, bags) or topics (bags).

    Raises:
        ConfigError: T_color_depth is not a rigid transform, or a stream of `topics` is unknown.
    """

    # True registers depth to the color camera, at the size of the color image.
    register_depth: bool = False
    # Replacements of the values in the files or in the data set's documentation; None
    # replaces nothing.
    color_camera: Camera | None = None
    depth_camera: Camera | None = None
    T_color_depth: np.ndarray | None = None  # Depth to color coordinates, [4, 4], meters.
    # Topics in a bag, by stream ("color" or "depth"); others are found by type and name.
    topics: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if unknown := sorted(self.topics.keys() - {"color", "depth"}):
            raise ConfigError(
                f"topics names the stream {unknown[0]!r}. Known streams: color, depth."
            )
        if self.T_color_depth is not None and not is_rigid(self.T_color_depth):
            raise ConfigError(
                f"T_color_depth is {self.T_color_depth.tolist()}, expected a rigid transform "
                "[4, 4] from depth to color coordinates in meters."
            )

    @property
    def is_default(self) -> bool:
        """True if no option of the registration is set."""
        return not self.register_depth and not self._given()

    def over(self, rig: Rig) -> Rig:
        """Return `rig` with the cameras and the transform that these options set."""
        return replace(rig, **self._given())

    def _given(self) -> dict[str, Camera | np.ndarray]:
        names = ("color_camera", "depth_camera", "T_color_depth")
        values = {name: getattr(self, name) for name in names}
        return {name: value for name, value in values.items() if value is not None}
