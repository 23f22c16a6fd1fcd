"""Optimization of the map against keyframes: Gaussians, exposures and, optionally, poses."""

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from math import inf

import numpy as np

from ldo_service.errors import ConfigError, DeviceError, named
from ldo_service.geometry import Camera, se3
from ldo_service.kernels.gpu.device import Device

from .adam import AdamConfig, residual_factor
from .device_choice import choose_backend, given
from .exposure import Exposure
from .loss import ImageLoss, LossWeights
from .model import GaussianMap
from .optimizer_backend import OptimizerBackend, ShapeLimits
from .plan_attempt import Observer, PlanAttempt, Views
from .pose_adam import PoseAdam
from .renderer import Rendering, VisibleGaussians
from .training_views import TrainingView

# Effort of an iteration at half resolution, relative to one at full resolution: the ratio of their
# times, which is 0.3 to 0.44, depending on the number of visible Gaussians.
HALF_EFFORT = 0.38
# Images with a shorter side are not halved, because too little of their detail would be left: in a
# test with 128x96 pixels, the mean error of objects rises above 10 cm.
MIN_HALVED_PX = 200

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class GaussianOptimizerConfig:
    """Settings of the Gaussian optimizer."""

    # Device of the iterations; auto: a GPU if it passes a self-test, otherwise the CPU.
    device: Device = "cpu"
    adam: AdamConfig = field(default_factory=AdamConfig)
    loss: LossWeights = field(default_factory=LossWeights)
    # Weight of the penalty on needle-shaped Gaussians: the mean excess of log(longest / middle
    # axis) over log(max_needle_ratio); see `Rasterizer.gradients`.
    needle_weight: float = 0.01
    # Ratio of the axes above which the penalty applies. Densification gives at most this ratio, on
    # surfaces seen at a grazing angle.
    max_needle_ratio: float = 4.0

    # Longest standard deviation of a Gaussian after a step, in pixels of the view; densification
    # gives at most 10. Without a limit, a single Gaussian grows over a whole wall and covers
    # surface that is observed there later. This costs 3 dB on held-out frames among the first 240
    # frames of an apartment. Limits of 14 and 10 cost 0.3 and 0.6 dB in the sequence kitchen.
    max_sigma_px: float = 20.0

    # Fraction of the computing time after a new keyframe that is spent on iterations at half
    # resolution, before those at full resolution. Iterations at half resolution improve the map
    # almost as much. All iterations are at half resolution if the rest of the effort is below 1.
    half_share: float = 0.8
    # Number of visible Gaussians at which an iteration is assumed to spend half of its time on the
    # pixels and half on the Gaussians. The effort of an iteration is computed from it.
    usual_reach: int = 60_000

    # Each iteration moves the exposure of its keyframe by this fraction of the way to the
    # estimate. 0 keeps the exposures constant; 1 gives the same quality as 0.3. Gradient
    # steps with a prior of gain 1 would lag behind the camera's exposure, which cost 2.3
    # dB in an apartment where gains vary by a fifth.
    exposure_share: float = 0.3
    # Learning rates of keyframe poses; 0 keeps the poses constant. 2e-4 gains 0.3 dB in the same
    # apartment. It adds 1 mm of noise to exact poses: on 90 frames of a Replica apartment, the
    # ATE is 0.13 cm with 2e-4 and 0.02 cm with 0.
    rotation_rate_rad: float = 0.0
    translation_rate_m: float = 0.0

    def __post_init__(self) -> None:
        rates = (self.rotation_rate_rad, self.translation_rate_m)
        if not 0 <= self.half_share <= 1:
            raise ConfigError(named(self, "half_share") + " must lie in 0..1.")
        if not (min(rates) >= 0 and 0 <= self.exposure_share <= 1 and self.needle_weight >= 0):
            raise ConfigError(
                named(
                    self,
                    "needle_weight",
                    "exposure_share",
                    "rotation_rate_rad",
                    "translation_rate_m",
                )
                + ": rates and weights must be at least 0, and exposure_share must lie in 0..1."
            )
        if self.usual_reach < 1:
            raise ConfigError(named(self, "usual_reach") + " must be at least 1.")
        if not self.max_sigma_px > 0:
            raise ConfigError(named(self, "max_sigma_px") + " must be positive; inf sets no limit.")
        if not self.max_needle_ratio >= 1:
            raise ConfigError(named(self, "max_needle_ratio") + " must be at least 1.")

    @property
    def limits(self) -> ShapeLimits:
        """Limits on the shape of the Gaussians."""
        return ShapeLimits(self.needle_weight, self.max_needle_ratio, self.max_sigma_px)

    @property
    def refines_poses(self) -> bool:
        """True if a learning rate of keyframe poses is above 0, so that poses are optimized too."""
        return self.rotation_rate_rad > 0 or self.translation_rate_m > 0


@dataclass(frozen=True, eq=False, slots=True)
class IterationResult:
    """Result of one iteration.

    Attributes:
        loss: Loss before the step.
        view: The training view with exposure and pose after the step.
        visible: Gaussians that may touch the image; valid until the next rendering. Their weights
            are sums over the pixels of the full image, also after a step at half resolution.
    """

    loss: ImageLoss
    view: TrainingView
    visible: VisibleGaussians


class GaussianOptimizer:
    """Optimizer of Gaussians, exposures and keyframe poses; Adam moments persist between calls.

    A plan is the sequence of keyframes for which `optimize` does one iteration each. The same map,
    training views and plan give bitwise equal results for any number of threads. If a GPU fails,
    the CPU runs the current plan or rendering again, and all later ones. Not thread-safe.

    Args:
        config: Settings.
        threads: Number of threads.
        backend: Backend that runs the iterations; None to choose it by `config.device`.

    Attributes:
        device: Device of iterations and renderings, with the reason for its choice.
    """

    def __init__(
        self,
        config: GaussianOptimizerConfig | None = None,
        *,
        threads: int = 1,
        backend: OptimizerBackend | None = None,
    ) -> None:
        self.config = config = config or GaussianOptimizerConfig()
        if backend is None:
            chosen = choose_backend(config.device, config.adam, config.loss, config.limits)
            self._backend, self.device = chosen
        else:
            self._backend, self.device = backend, given(backend)
        self._backend.threads = threads
        self._poses = PoseAdam()

    @property
    def threads(self) -> int:
        """Number of threads."""
        return self._backend.threads

    def optimize(
        self,
        gaussians: GaussianMap,
        views: Views,
        plan: Sequence[int],
        *,
        rates: tuple[float, float] = (1.0, 1.0),
        fixed: int | None = None,
        effort: float = inf,
        after_keyframe: bool = False,
        observe: Observer | None = None,
        is_usable: Callable[[int], bool] = lambda _: True,
    ) -> list[ImageLoss]:
        """Run one iteration for each training view of a plan.

        `gaussians` changes in place. Views with new exposures and poses are written to `views`.

        Args:
            gaussians: The map.
            views: Training views by keyframe.
            plan: Keyframes, in the order of the iterations.
            rates: Factors on the learning rates at the first and at the last iteration; they change
                geometrically in between. Use 1 while the map grows. At the end of a run, use less
                than 1, so that the map converges.
            fixed: Keyframe whose pose and exposure stay constant, to fix the pose and the
                brightness of the map. With None, no keyframe stays constant.
            effort: Limit of the computing time. The unit is the time of an iteration at full
                resolution with `usual_reach` visible Gaussians. With r times this number of
                Gaussians, an iteration takes (1 + r) / 2 units. At half resolution, this number of
                units is multiplied by HALF_EFFORT.
                No iteration starts once the sum has reached `effort`.
            after_keyframe: The plan follows a new keyframe. The learning rates then change with the
                color error of each image; see `residual_factor`. The iterations start at half
                resolution, for the fraction `half_share` of `effort`, or for all of it if less than
                1 unit would remain.
            observe: Function that is called after each iteration with the keyframe and the visible
                Gaussians; None for none.
            is_usable: Function that returns whether the map may be fitted to a keyframe now. It is
                called with the keyframe of each iteration; if it returns False, the iteration is
                skipped.

        Returns:
            Loss before each step, for the iterations that were run.
        """
        options = rates, fixed, effort, after_keyframe
        if self._backend.can_fail:
            attempt, poses = PlanAttempt(views, observe), self._poses.snapshot()
            try:
                with self._begun(gaussians):
                    losses = self._iterate(attempt, plan, *options, attempt.observe, is_usable)
            except DeviceError as error:
                attempt.undo()
                self._poses.restore(poses)
                self._continue_on_cpu(error)
            else:
                attempt.commit()
                return losses
        with self._begun(gaussians):
            return self._iterate(views, plan, *options, observe, is_usable)

    def render(
        self,
        gaussians: GaussianMap,
        camera: Camera,
        T_map_camera: np.ndarray,
        *,
        contributions: bool = False,
    ) -> Rendering:
        """Render the map on the device of the iterations, which leaves the optimizer as it is.

        Args:
            gaussians: The map.
            camera: Intrinsics without distortion.
            T_map_camera: Pose of the camera, [4, 4].
            contributions: Also compute the contributions of the Gaussians.

        Raises:
            DataError: The camera has lens distortion.
        """
        try:
            return self._backend.render_view(
                gaussians, camera, T_map_camera, contributions=contributions
            )
        except DeviceError as error:
            self._continue_on_cpu(error)
        return self._backend.render_view(
            gaussians, camera, T_map_camera, contributions=contributions
        )

    def _continue_on_cpu(self, error: DeviceError) -> None:
        self._backend, self.device = self._backend.on_cpu(), self.device.failed(error)
        log.error(
            "mapper: %s The CPU fits and renders the map from now on, and no keyframe is lost. "
            "Restart the service to use the GPU again.",
            self.device.reason,
            exc_info=error.__cause__,
        )

    @contextmanager
    def _begun(self, gaussians: GaussianMap) -> Iterator[None]:
        """Call `begin` of the backend before a `with` block, and `end` after it.

        Raises:
            DeviceError: The device failed. The map and the moments of its Gaussians are unchanged.
        """
        self._backend.begin(gaussians)
        try:
            yield
        except DeviceError:
            raise  # The map stays as it was at `begin`.
        except BaseException:
            with suppress(DeviceError):  # It would hide the error of the block.
                self._backend.end()
            raise
        self._backend.end()

    def _iterate(
        self,
        views: Views,
        plan: Sequence[int],
        rates: tuple[float, float],
        fixed: int | None,
        effort: float,
        after_keyframe: bool,
        observe: Observer | None,
        is_usable: Callable[[int], bool],
    ) -> list[ImageLoss]:
        losses, spent = [], 0.0
        half_effort = self._half_effort(effort) if after_keyframe else 0.0
        for rate, keyframe in zip(np.geomspace(*rates, len(plan)), plan, strict=True):
            if spent >= effort:
                break
            if not is_usable(keyframe):
                continue
            view = views[keyframe]
            side_px = min(view.camera.width, view.camera.height)
            is_half = spent < half_effort and side_px >= MIN_HALVED_PX
            step = self._step(view, rate, keyframe == fixed, is_half, after_keyframe)
            if step.view is not view:
                views[keyframe] = step.view
            if observe is not None:
                observe(keyframe, step.visible)
            losses.append(step.loss)
            full = (1 + len(step.visible.indices) / self.config.usual_reach) / 2
            spent += HALF_EFFORT * full if is_half else full
        return losses

    def _half_effort(self, effort: float) -> float:
        """Return the part of a limited `effort` that is spent on iterations at half resolution.

        All of it is, if the rest is too small for a whole iteration at full resolution.
        """
        share = self.config.half_share
        return effort if (1 - share) * effort < 1 else share * effort

    def step(
        self,
        gaussians: GaussianMap,
        view: TrainingView,
        *,
        rate: float = 1.0,
        is_fixed: bool = False,
        is_half: bool = False,
    ) -> IterationResult:
        """Run one iteration against one training view.

        Args:
            gaussians: The map.
            view: The training view.
            rate: Factor on all learning rates.
            is_fixed: Keep the exposure and the pose of the view constant.
            is_half: Render and compare the view at half resolution.

        Raises:
            DeviceError: The device failed. The map and the moments of its Gaussians are unchanged.
        """
        with self._begun(gaussians):
            return self._step(view, rate, is_fixed, is_half, False)

    def _step(
        self, view: TrainingView, rate: float, is_fixed: bool, is_half: bool, follows_error: bool
    ) -> IterationResult:
        self._backend.render(view, is_half=is_half)
        if not is_fixed:
            view = self._exposed(view)
        loss, visible = self._backend.descend(
            view.exposure,
            rate=lambda loss: rate * (residual_factor(loss.l1) if follows_error else 1.0),
        )
        if not is_fixed:
            view = self._placed(view, visible.xi, rate)
        return IterationResult(loss, view, visible)

    def _exposed(self, view: TrainingView) -> TrainingView:
        """Return the view with its exposure moved to that of the image that was rendered."""
        share = self.config.exposure_share
        if share == 0:
            return view
        found = self._backend.estimate_exposure()
        if found is None:
            return view
        before = view.exposure.matrix
        return replace(view, exposure=Exposure.of(before + share * (found.matrix - before)))

    def _placed(self, view: TrainingView, by_xi: np.ndarray, rate: float) -> TrainingView:
        config = self.config
        if not config.refines_poses:
            return view
        rates = np.repeat([config.rotation_rate_rad, config.translation_rate_m], 3)
        step = -rate * rates * self._poses.direction(view.keyframe, by_xi)
        T_map_camera = se3.orthonormalize(view.T_map_camera @ se3.exp(step))
        return replace(view, T_map_camera=T_map_camera)

    def steps(self, gaussians: GaussianMap) -> np.ndarray:
        """Return the number of Adam steps of each Gaussian, [N] int32.

        The number increases whenever the optimizer changes the Gaussian.
        """
        return self._backend.steps(gaussians)

    def forget_view(self, keyframe: int) -> None:
        """Drop the Adam moments of a keyframe whose pose will not be optimized again."""
        self._poses.forget(keyframe)

    def snapshot(self) -> dict[str, np.ndarray]:
        """Return a copy of all Adam moments as named arrays."""
        return self._backend.snapshot() | self._poses.snapshot()

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Restore the exact state of a `snapshot`."""
        self._backend.restore(state)
        self._poses.restore(state)
