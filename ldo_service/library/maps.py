"""The map of Gaussians as arrays and images."""

import os
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ldo_service.conversions.poses import pose_from_message
from ldo_service.errors import ConfigError
from ldo_service.gaussians.renderer import render
from ldo_service.geometry import Camera, se3
from ldo_service.maps.object_search import matching_objects
from ldo_service.schemas import MapObjects
from ldo_service.semantics.gaussian_labels import distribution
from ldo_service.semantics.semantic_fusion import label_image

from .arrays import read_only_array, rigid_transform


@dataclass(frozen=True, eq=False, slots=True)
class MapArrays:
    """Parameters of N Gaussians in the map frame, as read-only float32 arrays.

    Attributes:
        means_m: [N, 3], centers in meters.
        scales_m: [N, 3], standard deviations along the axes in meters.
        quaternions: [N, 4], unit quaternions wxyz, rotation from a Gaussian's axes to the map.
        opacities: [N], 0..1.
        colors: [N, 3], RGB, mostly within 0..1.
        label_probabilities: [N, C], probabilities of the C labels of `Map.label_names`. Each row
            sums to one. Without a detector, C is 0.
    """

    means_m: np.ndarray
    scales_m: np.ndarray
    quaternions: np.ndarray
    opacities: np.ndarray
    colors: np.ndarray
    label_probabilities: np.ndarray


@dataclass(frozen=True, eq=False, slots=True)
class MapView:
    """Rendering of the map at a camera pose, as read-only arrays.

    Attributes:
        color: [H, W, 3] float32, RGB, 0..1.
        depth_m: [H, W] float32, z in meters; 0 where the opacity is at most 0.5.
        opacity: [H, W] float32, 0..1.
        labels: [H, W] uint8, index into `Map.label_names`; None if no labels were requested.
    """

    color: np.ndarray
    depth_m: np.ndarray
    opacity: np.ndarray
    labels: np.ndarray | None


@dataclass(frozen=True, eq=False, slots=True)
class FoundObject:
    """An object of the map.

    Attributes:
        id: Number of the object.
        name: Likeliest name.
        score: Similarity of the name to the searched text, 0..1; 1 without a text.
        T_map_object: [4, 4], center and axes of the object's box in the map.
        size_m: [3], size of the box along its axes in meters.
        distance_m: Distance in meters from the last camera pose to the center of the box; None if
            there is no camera pose.
    """

    id: int
    name: str
    score: float
    T_map_object: np.ndarray
    size_m: np.ndarray
    distance_m: float | None

    @property
    def center_m(self) -> np.ndarray:
        """Center of the box in the map, [3], meters."""
        return self.T_map_object[:3, 3]


class Map:
    """State of the map at one time. Later frames do not change it.

    Attributes:
        camera: Rectified camera of the keyframes, the default camera of `render`.
        label_names: Names of the labels, by index; empty without a detector.
    """

    def __init__(
        self,
        rows: np.ndarray,
        labels: np.ndarray | None,
        label_names: tuple[str, ...],
        camera: Camera | None,
    ) -> None:
        self._rows, self._labels = rows, labels
        self.label_names, self.camera = label_names, camera

    def __len__(self) -> int:
        """Return the number of Gaussians."""
        return len(self._rows)

    def __repr__(self) -> str:
        return f"Map of {len(self):,} Gaussians with {len(self.label_names)} labels"

    def arrays(self) -> MapArrays:
        """Return the parameters of all Gaussians."""
        rows = self._rows
        quaternions = rows[:, 6:10] / np.maximum(
            np.linalg.norm(rows[:, 6:10], axis=1, keepdims=True), np.float32(1e-12)
        )
        probabilities = np.zeros((len(rows), 0), np.float32)
        if self._labels is not None and self.label_names:
            probabilities = distribution(self._labels, len(self.label_names))
        return MapArrays(
            read_only_array(rows[:, 0:3].copy()),
            read_only_array(np.exp(rows[:, 3:6])),
            read_only_array(quaternions),
            read_only_array(1 / (1 + np.exp(-rows[:, 10]))),
            read_only_array(rows[:, 11:14].copy()),
            read_only_array(probabilities),
        )

    def render(
        self,
        T_map_camera: np.ndarray,
        camera: Camera | None = None,
        *,
        labels: bool = False,
        threads: int | None = None,
    ) -> MapView:
        """Render the map at a camera pose.

        Args:
            T_map_camera: Camera pose in the map, [4, 4].
            camera: Camera of the image. Its distortion is ignored. None uses the camera of the
                keyframes.
            labels: Also render the label of each pixel, which takes several times as long.
            threads: Number of renderer threads; None for all cores. The number does not change the
                images.

        Raises:
            ConfigError: An argument is wrong, no camera is known because the map is empty, or the
                map has no labels.
        """
        if not (camera is None or isinstance(camera, Camera)):
            raise ConfigError(
                f"camera is a {type(camera).__name__}, must be an ldo_service.Camera."
            )
        camera = self.camera if camera is None else camera.rectified()
        if camera is None:
            raise ConfigError("the map is empty, so its camera is unknown. Give a camera.")
        if threads is not None and threads < 1:
            raise ConfigError(f"threads={threads} must be at least 1, or None for all cores.")
        if labels and self._labels is None:
            raise ConfigError(
                "the map has no labels, because the run had neither a detector nor a labeller. "
                "Repeat the run with the setting detector.model or vlm_labeller.model."
            )
        T_camera_map = se3.inverse(_map_pose("T_map_camera", T_map_camera))
        count = threads or os.cpu_count() or 1
        shown = render(self._rows, camera, T_camera_map, threads=count, contributions=labels)
        label_ids = None
        if labels and self._labels is not None:
            label_ids = read_only_array(
                label_image(self._rows, self._labels, shown, camera, T_camera_map, threads=count)
            )
        return MapView(
            read_only_array(shown.color.clip(0, 1)),
            read_only_array(shown.depth_m.astype(np.float32)),
            read_only_array(shown.opacity),
            label_ids,
        )


def find(
    objects: MapObjects | None, text: str | None, T_map_camera: Sequence[np.ndarray] | np.ndarray
) -> list[FoundObject]:
    """Return the objects that match a text, or all objects; the best match first.

    Args:
        objects: Objects of the map; None without a detector.
        text: Name or synonym of an object; None for all objects.
        T_map_camera: Camera poses, [M, 4, 4]. Object distances are measured from the last pose.
    """
    if objects is None:
        return []
    eye = T_map_camera[-1][:3, 3] if len(T_map_camera) else None
    return [
        FoundObject(
            one.id,
            one.name,
            one.score,
            read_only_array(pose_from_message(one.T_map_object)),
            read_only_array(np.array(one.size)),
            one.distance,
        )
        for one in matching_objects(text, objects, eye)
    ]


def _map_pose(name: str, value: object) -> np.ndarray:
    """Return a pose in the map that a caller passed as a rigid transform [4, 4] float64.

    Raises:
        ConfigError: The value is no rigid transform.
    """
    if value is None:
        raise ConfigError(
            f"{name} is None, because a frame with tracking status LOST has no pose. Give the pose "
            "of a frame with status OK or WEAK."
        )
    return rigid_transform(name, value, ConfigError)
