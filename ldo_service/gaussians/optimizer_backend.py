"""Backends that run the iterations of the Gaussian optimizer: interface and CPU backend."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from ldo_service.geometry import Camera, se3

from .adam import Adam, AdamConfig
from .exposure import Exposure, estimate_block_exposure
from .loss import ImageLoss, LossWeights, image_loss
from .model import GaussianMap
from .prepared_images import PreparedImage, PreparedImages
from .renderer import Rasterizer, Rendering, RenderMemory, VisibleGaussians, render
from .training_views import TrainingView

Rate = Callable[[ImageLoss], float]


@dataclass(frozen=True, slots=True)
class ShapeLimits:
    """Limits on the shape of the Gaussians during the optimization.

    Attributes:
        needle_weight: Weight of the penalty on needle-shaped Gaussians; see `Rasterizer.gradients`.
        max_needle_ratio: Ratio of the longest to the middle axis above which the penalty applies.
        max_sigma_px: Largest standard deviation after a step, in pixels of the full image.
    """

    needle_weight: float
    max_needle_ratio: float
    max_sigma_px: float


class OptimizerBackend(Protocol):
    """Interface of a backend that runs the iterations of the Gaussian optimizer.

    The optimizer calls `begin` first. It calls `render`, `estimate_exposure` and `descend` for each
    iteration, and `end` last. From `begin` to `end`, only the backend reads or writes the rows of
    the map.

    Attributes:
        can_fail: True if `render_view` and the methods from `begin` to `end` may raise DeviceError.
            After the error, the map and the moments are as they were before the call, or at
            `begin`. The results of `descend` of such a backend stay valid after the next rendering.
    """

    can_fail: bool

    @property
    def threads(self) -> int:
        """Number of threads; it may change between calls and does not change the results."""
        ...

    @threads.setter
    def threads(self, count: int) -> None: ...

    def begin(self, gaussians: GaussianMap) -> None:
        """Prepare iterations on a map."""

    def end(self) -> None:
        """Write the results of the iterations to the map, if they are not there yet."""

    def on_cpu(self) -> "CpuBackend":
        """Return a backend on the CPU that continues with the state of the last `end`."""
        ...

    def render(self, view: TrainingView, *, is_half: bool) -> None:
        """Render the map at the pose of a view, at half resolution if `is_half` is True."""

    def estimate_exposure(self) -> Exposure | None:
        """Estimate the exposure of the last rendered view; see `exposure.estimate_exposure`."""
        ...

    def descend(self, exposure: Exposure, *, rate: Rate) -> tuple[ImageLoss, VisibleGaussians]:
        """Compare the result of the last `render` with its view, and take a step of Adam.

        A backend may change the map now or only in `end`.

        Args:
            exposure: Exposure of the view.
            rate: Function that returns the factor on all learning rates from the loss.

        Returns:
            Loss before the step, and the visible Gaussians. If `can_fail` is False, these are valid
            only until the next rendering. Blending weights are sums over the pixels of the full
            image: after a rendering at half resolution, the sums are multiplied by 4.
        """
        ...

    def render_view(
        self,
        gaussians: GaussianMap,
        camera: Camera,
        T_map_camera: np.ndarray,
        *,
        contributions: bool,
    ) -> Rendering:
        """Render a map for other purposes than an iteration; see `GaussianOptimizer.render`.

        Call it only after `end`. It changes neither the map nor the moments.
        """
        ...

    def steps(self, gaussians: GaussianMap) -> np.ndarray:
        """Return the number of Adam steps of each Gaussian, [N] int32. Call it only after `end`."""
        ...

    def snapshot(self) -> dict[str, np.ndarray]:
        """Return a copy of the Adam moments as named arrays, in a format common to all backends."""
        ...

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Restore the exact state of a `snapshot`."""


class CpuBackend:
    """Backend that runs the iterations of the Gaussian optimizer on the CPU, in C++.

    The results are bitwise equal for any number of threads.

    Args:
        adam: Settings of Adam.
        weights: Weights of the image loss.
        limits: Limits on the shape of the Gaussians.
        threads: Number of threads.
    """

    can_fail: bool = False

    def __init__(
        self, adam: AdamConfig, weights: LossWeights, limits: ShapeLimits, *, threads: int = 1
    ) -> None:
        self._adam, self._weights, self._limits = Adam(adam), weights, limits
        # Views are rendered between plans, so both can use the same scratch memory.
        self._memory = RenderMemory()
        self._rasterizer = Rasterizer(threads=threads, memory=self._memory)
        self._by_planes = np.empty((5, 0, 0), np.float32)
        self._gaussians: GaussianMap | None = None  # Map between `begin` and `end`.
        self._images = PreparedImages()
        # Images of the last rendering in the resolution of the rendering, its planes and binning.
        self._rendered: tuple[PreparedImage, np.ndarray, int] | None = None

    @property
    def threads(self) -> int:
        return self._rasterizer.threads

    @threads.setter
    def threads(self, count: int) -> None:
        self._rasterizer.threads = count

    def begin(self, gaussians: GaussianMap) -> None:
        self._gaussians = gaussians

    def end(self) -> None:
        self._gaussians = self._rendered = None

    def on_cpu(self) -> "CpuBackend":
        return self

    def render(self, view: TrainingView, *, is_half: bool) -> None:
        prepared = self._images.get(view, is_half=is_half)
        binning = 2 if is_half else 1
        gaussians = self._map()
        planes = self._rasterizer.render(
            gaussians.rows,
            prepared.image.camera,
            se3.inverse(view.T_map_camera),
            bounds=gaussians.bounds,
            binning=binning,
        )
        self._rendered = prepared, planes, binning

    def estimate_exposure(self) -> Exposure | None:
        prepared, planes, _ = self._last()
        return estimate_block_exposure(planes[:3], planes[4], prepared.blocks)

    def descend(self, exposure: Exposure, *, rate: Rate) -> tuple[ImageLoss, VisibleGaussians]:
        prepared, planes, binning = self._last()
        image = prepared.image
        if self._by_planes.shape != planes.shape:
            self._by_planes = np.empty_like(planes)
        loss = image_loss(
            planes,
            image.color,
            image.depth_m,
            exposure,
            self._weights,
            self._by_planes,
            mask=image.mask,
            threads=self.threads,
        )
        visible = self._adam.step_fused(
            self._map(),
            self._rasterizer,
            self._by_planes,
            rate=rate(loss),
            needle_weight=self._limits.needle_weight,
            needle_ratio=self._limits.max_needle_ratio,
            max_sigma_px=self._limits.max_sigma_px / binning,
        )
        if binning > 1:  # The weights are sums over the pixels of the full image.
            visible = replace(visible, weights=visible.weights * binning**2)
        return loss, visible

    def render_view(
        self,
        gaussians: GaussianMap,
        camera: Camera,
        T_map_camera: np.ndarray,
        *,
        contributions: bool,
    ) -> Rendering:
        return render(
            gaussians.rows,
            camera,
            se3.inverse(T_map_camera),
            bounds=gaussians.bounds,
            memory=self._memory,
            contributions=contributions,
            threads=self.threads,
        )

    def _map(self) -> GaussianMap:
        assert self._gaussians is not None, "begin comes first"
        return self._gaussians

    def _last(self) -> tuple[PreparedImage, np.ndarray, int]:
        assert self._rendered is not None, "render comes first"
        return self._rendered

    def steps(self, gaussians: GaussianMap) -> np.ndarray:
        return self._adam.steps(gaussians)

    def snapshot(self) -> dict[str, np.ndarray]:
        return self._adam.snapshot()

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        self._adam.restore(state)
