"""GPU backend of the Gaussian optimizer; it is experimental."""

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass
from math import log10
from weakref import ref

import numpy as np

from ldo_service.errors import DeviceError
from ldo_service.geometry import Camera, se3
from ldo_service.kernels.gpu import descent, frame_loss, plane_rendering, view_rendering
from ldo_service.kernels.gpu.arrays import Arrays
from ldo_service.kernels.gpu.device import device_errors

from .adam import Adam, AdamConfig
from .exposure import Exposure, ImageBlocks, block_side, fit_blocks
from .gpu_mirror import GaussianMirror
from .loss import ImageLoss, LossWeights
from .model import GaussianMap
from .optimizer_backend import CpuBackend, Rate, ShapeLimits
from .renderer import Contributions, Rendering, VisibleGaussians, require_undistorted
from .training_views import TrainingView

# Number of images that stay on the device, at 8 bytes a pixel. A keyframe counts twice if it is
# used at full and at half resolution.
MAX_FRAMES = 64


@dataclass(frozen=True, eq=False, slots=True)
class ResidentFrame:
    """Copy of the images of a training view in GPU memory.

    Attributes:
        color: Weak reference to the color image of the view in host memory.
        depth_m: Weak reference to the depth image of the view in host memory.
        mask: Weak reference to the mask of the view in host memory; None if it has no mask.
        image: Color, depth and mask in GPU memory.
        size: Width and height of the copy, pixels.
        intrinsics: fx, fy, cx, cy of the copy, pixels.
        blocks: Mean colors of pixel blocks, for the estimate of the exposure.
    """

    color: ref[np.ndarray]
    depth_m: ref[np.ndarray]
    mask: ref[np.ndarray] | None
    image: frame_loss.Frame
    size: tuple[int, int]
    intrinsics: tuple[float, float, float, float]
    blocks: ImageBlocks

    def shows(self, view: TrainingView) -> bool:
        """Return whether these are the images of `view`."""
        mask = self.mask and self.mask()
        return (
            self.color() is view.color
            and self.depth_m() is view.depth_m
            and (view.mask is None if self.mask is None else mask is view.mask)
        )


class GpuBackend:
    """Backend that runs iterations of the Gaussian optimizer with the kernels of `kernels.gpu`.

    The GPU works on a copy of the map and of the Adam moments. `begin` uploads changed rows, and
    `end` downloads the rows that the iterations changed. Each iteration downloads the blending
    weights of the visible Gaussians, the terms of the loss, and mean colors for the exposure.

    The results are bitwise equal on one GPU model and one version of Triton. They differ from those
    of the CPU in the last bits of each iteration.

    Args:
        arrays: Array operations on the GPU.
        adam: Settings of Adam.
        weights: Weights of the image loss.
        limits: Limits on the shape of the Gaussians.
    """

    can_fail: bool = True

    def __init__(
        self, arrays: Arrays, adam: AdamConfig, weights: LossWeights, limits: ShapeLimits
    ) -> None:
        self.threads = 1
        self._arrays, self._config = arrays, adam
        self._adam, self._weights, self._limits = Adam(adam), weights, limits
        self._corrections = arrays.upload(descent.bias_corrections(adam.beta1, adam.beta2))
        self._frames: OrderedDict[tuple[int, bool], ResidentFrame] = OrderedDict()
        self._gaussians: GaussianMap | None = None  # Map between `begin` and `end`.
        self._rendered: tuple[ResidentFrame, plane_rendering.PlaneRendering, int] | None = None
        self.mirror = GaussianMirror(arrays)

    def begin(self, gaussians: GaussianMap) -> None:
        self._gaussians = gaussians
        with device_errors("upload of the map"):
            self.mirror.update(gaussians, self._adam)

    def end(self) -> None:
        gaussians, self._gaussians, self._rendered = self._gaussians, None, None
        if gaussians is not None:
            with device_errors("download of the map"):
                self.mirror.write_back(gaussians, self._adam)

    def on_cpu(self) -> CpuBackend:
        backend = CpuBackend(self._config, self._weights, self._limits, threads=self.threads)
        backend.restore(self.snapshot())
        return backend

    def render(self, view: TrainingView, *, is_half: bool) -> None:
        assert self._gaussians is not None, "begin comes first"
        binning = 2 if is_half else 1
        T_camera_map = se3.inverse(view.T_map_camera)
        with device_errors("rendering"):
            frame = self._frame(view, is_half)
            values = plane_rendering.view_of(T_camera_map, frame.intrinsics, binning)
            rendering = plane_rendering.render(
                self._arrays, self.mirror.rows, len(self._gaussians), values, *frame.size
            )
        self._rendered = frame, rendering, binning

    def estimate_exposure(self) -> Exposure | None:
        frame, rendering, _ = self._last()
        side = block_side(rendering.width)
        with device_errors("estimate of the exposure"):
            means = plane_rendering.mean_blocks(self._arrays, rendering, side)
        return fit_blocks(means[:3], means[3], frame.blocks)

    def descend(self, exposure: Exposure, *, rate: Rate) -> tuple[ImageLoss, VisibleGaussians]:
        with device_errors("step"):
            return self._descend(exposure, rate)

    def _descend(self, exposure: Exposure, rate: Rate) -> tuple[ImageLoss, VisibleGaussians]:
        frame, rendering, binning = self._last()
        weights = self._weights
        by_planes, (l1, d_ssim, depth, squared) = frame_loss.image_loss(
            self._arrays,
            rendering,
            frame.image,
            exposure.matrix,
            (weights.l1, weights.d_ssim, weights.depth),
        )
        total = weights.l1 * l1 + weights.d_ssim * d_ssim + weights.depth * depth
        psnr_db = -10 * log10(max(squared, 1e-20))
        loss = ImageLoss(total, l1, d_ssim, depth, psnr_db)
        mirror, config = self.mirror, self._config
        adam = descent.AdamState(
            mirror.moments,
            mirror.squares,
            mirror.steps,
            self._corrections,
            config.beta1,
            config.beta2,
            config.epsilon,
        )
        made = descent.backpropagate(
            self._arrays,
            mirror.rows,
            rendering,
            by_planes,
            adam=adam,
            rates=config.rates() * np.float32(rate(loss)),
            needle_weight=self._limits.needle_weight,
            needle_ratio=self._limits.max_needle_ratio,
            max_sigma_px=self._limits.max_sigma_px / binning,
        )
        visible = VisibleGaussians(
            self._arrays.download(rendering.lists.visible).astype(np.uint32),
            self._arrays.download(made.weights) * np.float32(binning**2),
            made.xi,
        )
        if not np.isfinite([total, squared, *made.xi]).all():
            # The pose would not be rigid in the next iteration.
            raise DeviceError(
                "the GPU computed NaN or infinity in the loss or in its derivative with respect to "
                "the pose. If this happens again, set service.device=cpu."
            )
        return loss, visible

    def _last(self) -> tuple[ResidentFrame, plane_rendering.PlaneRendering, int]:
        assert self._rendered is not None, "render comes first"
        return self._rendered

    def _frame(self, view: TrainingView, is_half: bool) -> ResidentFrame:
        """Return the images of a view on the device; upload them if they are not there."""
        key = (view.keyframe, is_half)
        frame = self._frames.get(key)
        if frame is None or not frame.shows(view):
            frame = self._uploaded(view, view.halved() if is_half else view)
            self._frames[key] = frame
        self._frames.move_to_end(key)
        if len(self._frames) > MAX_FRAMES:
            self._frames.popitem(last=False)
        return frame

    def _uploaded(self, view: TrainingView, image: TrainingView) -> ResidentFrame:
        mask = np.ones_like(image.color[0]) if image.mask is None else image.mask
        measured = int(np.count_nonzero((image.depth_m > 0) & (mask > 0)))
        color, depth_m, mask = map(self._arrays.upload, (image.color, image.depth_m, mask))
        camera = image.camera
        return ResidentFrame(
            ref(view.color),
            ref(view.depth_m),
            None if view.mask is None else ref(view.mask),
            frame_loss.Frame(color, depth_m, mask, measured),
            (camera.width, camera.height),
            (camera.fx, camera.fy, camera.cx, camera.cy),
            ImageBlocks.of(image.color, image.mask),
        )

    def render_view(
        self,
        gaussians: GaussianMap,
        camera: Camera,
        T_map_camera: np.ndarray,
        *,
        contributions: bool,
    ) -> Rendering:
        require_undistorted(camera)
        with device_errors("rendering of a view"):
            return self._render_view(gaussians.rows, camera, T_map_camera, contributions)

    def _render_view(
        self, rows: np.ndarray, camera: Camera, T_map_camera: np.ndarray, contributions: bool
    ) -> Rendering:
        # The mirror stays as it is: its update would match the moments to the map, and the next
        # plan would then depend on the renderings before it.
        arrays, intrinsics = self._arrays, (camera.fx, camera.fy, camera.cx, camera.cy)
        rendering = plane_rendering.render(
            arrays,
            arrays.upload(rows),
            len(rows),
            plane_rendering.view_of(se3.inverse(T_map_camera), intrinsics),
            camera.width,
            camera.height,
        )
        planes = arrays.download(rendering.planes)
        median_depth_m = arrays.download(view_rendering.median_depth(arrays, rendering))
        if not (np.isfinite(planes).all() and np.isfinite(median_depth_m).all()):
            raise DeviceError("the GPU computed NaN or infinity in a rendering")
        color = np.ascontiguousarray(planes[:3].transpose(1, 2, 0))
        made_by = self._contributions(rendering) if contributions else None
        return Rendering(color, planes[3], median_depth_m, planes[4], made_by)

    def _contributions(self, rendering: plane_rendering.PlaneRendering) -> Contributions:
        arrays, found = self._arrays, view_rendering.contributions_to(self._arrays, rendering)
        indices = arrays.download(rendering.lists.visible).astype(np.uint32)
        weights = arrays.download(found.weights)
        is_seen = weights > 0
        return Contributions(indices[is_seen], weights[is_seen], arrays.download(found.top))

    def steps(self, gaussians: GaussianMap) -> np.ndarray:
        return self._adam.steps(gaussians)

    def snapshot(self) -> dict[str, np.ndarray]:
        return self._adam.snapshot()

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        self._adam.restore(state)
