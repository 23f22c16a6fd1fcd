"""Rendering of the map at the poses of its keyframes."""

import numpy as np

from ldo_service.geometry import Camera

from .fitting import Fitting
from .keyframe_store import KeyframeViews
from .model import GaussianMap
from .renderer import Rendering


class KeyframeRenderer:
    """Renderer of the Gaussians in memory; it caches the last rendering at a keyframe."""

    def __init__(self, views: KeyframeViews, fitting: Fitting) -> None:
        """Create a renderer with an empty cache.

        Args:
            views: Cameras and poses of the keyframes.
            fitting: Fitting of the map, on the device that also renders it.
        """
        self._views, self._fitting = views, fitting
        # Cached rendering of one keyframe; None after a change of the map.
        self._cached: tuple[int, Rendering] | None = None

    def forget(self) -> None:
        """Drop the cached rendering; call it whenever the map changes."""
        self._cached = None

    def render_from(
        self,
        gaussians: GaussianMap,
        camera: Camera,
        T_map_camera: np.ndarray,
        *,
        contributions: bool = False,
    ) -> Rendering:
        """Render the Gaussians from a camera pose T_map_camera [4, 4].

        With `contributions`, the contribution of each Gaussian is computed too; see `render`.
        """
        return self._fitting.render(gaussians, camera, T_map_camera, contributions=contributions)

    def render_keyframe(
        self, gaussians: GaussianMap, keyframe: int, *, contributions: bool = False
    ) -> Rendering:
        """Render the Gaussians at the pose of a keyframe, or return the cached rendering.

        With `contributions`, the contribution of each Gaussian is computed too; see `render`.
        """
        if self._cached is None or self._cached[0] != keyframe:
            self._cached = None
        if self._cached is None or (contributions and self._cached[1].contributions is None):
            camera, pose = self._views.cameras[keyframe], self._views.poses[keyframe]
            self._cached = (
                keyframe,
                self.render_from(gaussians, camera, pose, contributions=contributions),
            )
        return self._cached[1]
