"""Color and depth cameras of a sensor, and registration between them."""

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from ldo_service.errors import ConfigError
from ldo_service.geometry import Camera, RawFrame, Trajectory, se3
from ldo_service.geometry.registration import register_depth, resample_color
from ldo_service.geometry.sequence import Sequence

from .files import is_rigid


@dataclass(frozen=True, slots=True, eq=False)
class Rig:
    """Intrinsics and relative pose of the color and the depth camera of a sensor."""

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
        """Convert poses [..., 4, 4] of the depth camera to poses of the color camera."""
        return T_world_depth @ se3.inverse(self.T_color_depth)


@dataclass(frozen=True, slots=True, eq=False)
class SequenceOptions:
    """Options for the registration of depth (ScanNet, 7-Scenes, bags) and the topics of bags.

    Raises:
        ConfigError: T_color_depth is not a rigid transform, or `topics` has an unknown key.
    """

    # True registers depth to the color camera, at the size of the color image.
    register_depth: bool = False
    # Replacements of the values in the files or in the data set's documentation; None
    # replaces nothing.
    color_camera: Camera | None = None
    depth_camera: Camera | None = None
    T_color_depth: np.ndarray | None = None  # Depth to color coordinates, [4, 4], meters.
    # Topics in a bag, by stream ("color", "depth" or "odometry"); others are found by type and
    # name.
    topics: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if unknown := sorted(self.topics.keys() - {"color", "depth", "odometry"}):
            raise ConfigError(
                f"topics has the unknown key {unknown[0]!r}. Use color, depth or odometry as a key."
            )
        if self.T_color_depth is not None and not is_rigid(self.T_color_depth):
            raise ConfigError(
                f"T_color_depth is {self.T_color_depth.tolist()}, expected a rigid transform "
                "[4, 4] from depth to color coordinates in meters."
            )

    @property
    def is_default(self) -> bool:
        """True if all options for the registration of depth have their defaults."""
        return not self.register_depth and not self._given()

    def over(self, rig: Rig) -> Rig:
        """Return a copy of `rig` with the cameras and the transform that these options give."""
        return replace(rig, **self._given())

    def _given(self) -> dict[str, Camera | np.ndarray]:
        names = ("color_camera", "depth_camera", "T_color_depth")
        values = {name: getattr(self, name) for name in names}
        return {name: value for name, value in values.items() if value is not None}


class RigSequence(Sequence):
    """Sequence of two cameras, whose images are brought to one pixel grid.

    If both cameras have equal center and orientation, color is resampled to the depth image, which
    does not change. Otherwise, or with `SequenceOptions.register_depth`, depth is registered to the
    color camera. The poses of a data set are assumed to be those of the depth camera.

    Attributes:
        rig: Cameras of the images in the data set.
    """

    def __init__(
        self, name: str, rig: Rig, stamps_ns: np.ndarray, options: SequenceOptions
    ) -> None:
        self.rig = options.over(rig)
        self._is_registering = options.register_depth or not self.rig.is_one_view
        camera = self.rig.color_camera if self._is_registering else self.rig.depth_camera
        super().__init__(name, camera, stamps_ns)
        self.registration = "reader" if self._is_registering else "source"

    @abstractmethod
    def read_images(self, index: int) -> tuple[np.ndarray, np.ndarray, float]:
        """Return color [Hc, Wc, 3] uint8 RGB, depth [Hd, Wd] uint16, and its units per meter.

        Raises:
            FrameError: An image cannot be read.
        """

    @abstractmethod
    def read_depth_poses(self) -> Trajectory | None:
        """Return `T_world_camera` of the depth camera, or None if no frame has a pose.

        Raises:
            DataError: A pose cannot be read.
        """

    def read(self, index: int) -> RawFrame:
        """Return a frame; see `Sequence.read`."""
        images = self.rig.on_one_grid(*self.read_images(index), self._is_registering)
        return RawFrame(index, int(self.stamps_ns[index]), *images, self.raw_camera)

    def truth(self) -> Trajectory | None:
        """Return the ground-truth trajectory, or None if no frame has a pose.

        If depth is registered to the color camera, the poses are those of the color camera, else
        those of the depth camera.
        """
        poses = self.read_depth_poses()
        if poses is None or not self._is_registering:
            return poses
        return replace(poses, T_world_camera=self.rig.T_world_color(poses.T_world_camera))
