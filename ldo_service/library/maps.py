"""The map of Gaussians as arrays and images."""

import os
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ldo_service.errors import ConfigError
from ldo_service.gaussians.renderer import render
from ldo_service.geometry import Camera, se3
from ldo_service.maps.object_search import ObjectMatch, matching_objects
from ldo_service.schemas import MapObjects
from ldo_service.semantics.gaussian_labels import distribution
from ldo_service.semantics.semantic_fusion import label_image

RIGID_TOLERANCE = 1e-4  # Largest deviation of R R^T from the identity in a pose of a user.


@dataclass(frozen=True, eq=False, slots=True)
class MapArrays:
    """Parameters of N Gaussians in the map frame, as read-only arrays."""

    means_m: np.ndarray  # [N, 3] float32, centers in meters.
    scales_m: np.ndarray  # [N, 3] float32, standard deviations along the axes in meters.
    quaternions: np.ndarray  # [N, 4] float32, unit quaternions wxyz that rotate the axes.
    opacities: np.ndarray  # [N] float32, 0..1.
    colors: np.ndarray  # [N, 3] float32, RGB, mostly within 0..1.
    # [N, C] float32, probabilities of the C labels of `Map.label_names`; each row sums to one.
    # Without a detector, C is 0.
    label_probabilities: np.ndarray


@dataclass(frozen=True, eq=False, slots=True)
class MapView:
    """Rendering of the map at a camera pose, as read-only arrays."""

    color: np.ndarray  # [H, W, 3] float32, RGB, 0..1.
    depth_m: np.ndarray  # [H, W] float32, z in meters; 0 where the opacity is at most 0.5.
    opacity: np.ndarray  # [H, W] float32, 0..1.
    # [H, W] uint8, index into `Map.label_names`; None if no labels were requested.
    labels: np.ndarray | None


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
            _read_only(rows[:, 0:3].copy()),
            _read_only(np.exp(rows[:, 3:6])),
            _read_only(quaternions),
            _read_only(1 / (1 + np.exp(-rows[:, 10]))),
            _read_only(rows[:, 11:14].copy()),
            _read_only(probabilities),
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
            threads: Threads of the renderer; None for all cores. The images are the same.

        Raises:
            ConfigError: The pose is not rigid, or no camera is known because the map is empty.
        """
        camera = self.camera if camera is None else camera.rectified()
        if camera is None:
            raise ConfigError("the map is empty, so its camera is unknown. Give a camera.")
        T_camera_map = se3.inverse(_require_pose("T_map_camera", T_map_camera))
        count = threads or os.cpu_count() or 1
        shown = render(self._rows, camera, T_camera_map, threads=count, contributions=labels)
        label_ids = None
        if labels:
            if self._labels is None:
                raise ConfigError("the map has no labels, because the run had no detector.")
            label_ids = label_image(
                self._rows, self._labels, shown, camera, T_camera_map, threads=count
            )
            label_ids.flags.writeable = False
        return MapView(
            _read_only(shown.color.clip(0, 1)),
            _read_only(shown.depth_m.astype(np.float32)),
            _read_only(shown.opacity),
            label_ids,
        )


def find(
    objects: MapObjects | None, text: str | None, T_map_camera: Sequence[np.ndarray] | np.ndarray
) -> list[ObjectMatch]:
    """Return the objects that match a text, or all objects; the best match first.

    Args:
        objects: Objects of the map; None without a detector.
        text: Name or synonym of an object; None for all objects.
        T_map_camera: Camera poses, [M, 4, 4]. Distances are from the last one.
    """
    if objects is None:
        return []
    eye = T_map_camera[-1][:3, 3] if len(T_map_camera) else None
    return matching_objects(text, objects, eye)


def _require_pose(name: str, value: np.ndarray) -> np.ndarray:
    """Return a rigid transform [4, 4] float64 of a user.

    Raises:
        ConfigError: It is not a rigid transform.
    """
    T = np.asarray(value, float)
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise ConfigError(f"{name} has the shape {T.shape}, must be a finite pose of shape (4, 4).")
    R = T[:3, :3]
    is_rigid = np.abs(R @ R.T - np.eye(3)).max() < RIGID_TOLERANCE and np.linalg.det(R) > 0
    if not is_rigid or not np.array_equal(T[3], (0, 0, 0, 1)):
        raise ConfigError(
            f"{name} is not a rigid transform: its rotation must be orthonormal without a "
            "reflection, and its last row 0 0 0 1."
        )
    return se3.orthonormalize(T)


def _read_only(array: np.ndarray) -> np.ndarray:
    array.flags.writeable = False
    return array
