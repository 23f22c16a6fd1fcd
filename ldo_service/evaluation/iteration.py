"""Timing of each step of an iteration of the Gaussian optimizer, on a synthetic scene."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ldo_service.gaussians import (
    Adam,
    Exposure,
    GaussianMap,
    LossWeights,
    Rasterizer,
    RowGradients,
    VisibleGaussians,
    image_loss,
)
from ldo_service.geometry import Camera, se3

Steps = dict[str, Callable[[], object]]
_WEIGHTS = LossWeights(l1=0.8, d_ssim=0.2, depth=1.0)


def bench_camera(width: int, height: int) -> Camera:
    """Return a camera with a horizontal field of view of about 63 degrees, like RGB-D cameras."""
    return Camera(width, height, 0.82 * width, 0.82 * width, (width - 1) / 2, (height - 1) / 2)


def walls(n: int, camera: Camera, seed: int = 0) -> np.ndarray:
    """Return flat Gaussians, rows [n, 16], on the walls of a room around the camera.

    The Gaussians are sorted by the image row of their centers. Each Gaussian covers about the
    fraction 1/n of the image. If the aspect ratio is 4:3, 14 % of the centers lie outside of the
    image.
    """
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-0.65, 0.65, n), np.sort(rng.uniform(-0.5, 0.5, n))
    z = np.minimum(4, np.minimum(1.5 / np.abs(y).clip(0.01), 2.2 / np.abs(x).clip(0.01)))
    z *= 1 + 0.02 * rng.standard_normal(n)
    sigma_m = 0.9 * z * np.sqrt(camera.width * camera.height / max(n, 1)) / camera.fx
    rows = np.zeros((n, 16), np.float32)
    rows[:, :3] = np.stack([x * z, y * z, z], -1)
    rows[:, 3:6] = np.log(sigma_m[:, None] * [1, 1, 0.2] * rng.uniform(0.6, 1.5, (n, 3)))
    rows[:, 6:10] = rng.standard_normal((n, 4))
    rows[:, 10] = rng.uniform(0, 4, n)
    rows[:, 11:14] = rng.uniform(0, 1, (n, 3))
    return rows


def noise_frame(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return random color [3, H, W] uint8 and random depth [H, W] in meters, 0 where unknown."""
    rng = np.random.default_rng(1)
    depth_m = rng.uniform(1, 4, (camera.height, camera.width)).astype(np.float32)
    depth_m[rng.uniform(size=depth_m.shape) < 0.2] = 0
    return rng.integers(0, 256, (3, camera.height, camera.width), np.uint8), depth_m


class Iteration:
    """Optimizer iteration on one training image, split into the steps of `GaussianOptimizer.step`.

    Args:
        n: Number of Gaussians in front of the camera.
        camera: Camera of the training image.
        threads: Number of threads of the kernels.
        elsewhere: Number of additional Gaussians outside of the image, in other directions.
    """

    def __init__(self, n: int, camera: Camera, *, threads: int = 1, elsewhere: int = 0) -> None:
        self.camera, self.threads = camera, threads
        self.gaussians = GaussianMap(n + elsewhere)
        self.gaussians.add(walls(n, camera), 0)
        for keyframe, part in enumerate(_shares(elsewhere, n)):
            self.gaussians.add(walls(part, camera, keyframe), 1 + keyframe)
        self.gaussians.move_anchors(_turned_away(range(1, 1 + len(_shares(elsewhere, n)))))
        self._rasterizer, self._adam = Rasterizer(threads=threads), Adam()
        self._color, self._depth_m = noise_frame(camera)
        self._exposure = Exposure()
        self._planes = self.forward()
        self._by_planes = np.empty_like(self._planes)

    def forward(self) -> np.ndarray:
        """Render color (3 planes), weighted depth and opacity of the image, [5, H, W]."""
        self._planes = self._rasterizer.render(
            self.gaussians.rows, self.camera, np.eye(4), bounds=self.gaussians.bounds
        )
        return self._planes

    def loss(self) -> np.ndarray:
        """Compute the loss derivatives with respect to the planes of `forward`, [5, H, W]."""
        frame = self._color, self._depth_m, self._exposure
        image_loss(self._planes, *frame, _WEIGHTS, self._by_planes, threads=self.threads)
        return self._by_planes

    def backward(self) -> RowGradients:
        """Compute the loss derivatives with respect to Gaussians and camera pose, without Adam."""
        return self._rasterizer.gradients(self._by_planes)

    def descent(self) -> VisibleGaussians:
        """Compute the same derivatives as `backward`, and take a step of Adam in the same pass.

        Returns:
            The Gaussians that contribute to the image. The step changed these Gaussians.
        """
        return self._adam.step_fused(self.gaussians, self._rasterizer, self._by_planes, rate=0.1)

    def steps(self) -> Steps:
        """Return the steps of an optimizer iteration as functions by name, to time each of them."""
        return {"forward": self.forward, "loss": self.loss, "descent": self.descent}


@dataclass(frozen=True, slots=True)
class IterationTimes:
    """Median times of the steps of an iteration in milliseconds.

    Adam updates the Gaussians inside the backward pass. `adam_ms` is the time that this update adds
    to the backward pass.
    """

    forward_ms: float
    loss_ms: float
    backward_ms: float
    adam_ms: float
    iteration_ms: float


def iteration_times(
    iteration: Iteration, repeats: int, clock: Callable[[], float] = time.perf_counter
) -> IterationTimes:
    """Measure the median times of the steps of `iteration` over `repeats` repetitions."""
    unfused = {"again": iteration.forward, "backward": iteration.backward}
    (times,) = medians_ms([iteration.steps() | unfused], repeats, clock)
    backward_ms = min(times["backward"], times["descent"])
    return IterationTimes(
        times["forward"],
        times["loss"],
        backward_ms,
        times["descent"] - backward_ms,
        times["iteration"],
    )


def medians_ms(
    runs: Sequence[Steps], repeats: int, clock: Callable[[], float] = time.perf_counter
) -> list[dict[str, float]]:
    """Measure the median time of each step of each run in milliseconds.

    The runs take turns in every repetition, so that other load on the machine affects all runs
    equally. One repetition for warm-up comes first and does not count. If a run has the step
    "descent", its result also has the key "iteration" with the time of the whole iteration.

    Args:
        runs: Runs to compare; each is a dictionary of functions by the name of the step.
        repeats: Number of repetitions.
        clock: Function that returns the time in seconds.
    """
    times: list[dict[str, list[float]]] = [{name: [] for name in steps} for steps in runs]
    for _ in range(repeats + 1):
        for steps, lists in zip(runs, times, strict=True):
            for name, step in steps.items():
                start = clock()
                step()
                lists[name].append(clock() - start)
    return [_medians(lists) for lists in times]


def _medians(times_s: dict[str, list[float]]) -> dict[str, float]:
    times_ms = {name: np.array(values[1:]) * 1e3 for name, values in times_s.items()}
    if "descent" in times_ms:
        parts = [times_ms[name] for name in ("forward", "loss", "descent")]
        times_ms["iteration"] = np.sum(parts, axis=0)
    return {name: float(np.median(values)) for name, values in times_ms.items()}


def _shares(n: int, largest: int) -> list[int]:
    return [min(largest, n - start) for start in range(0, n, max(largest, 1))]


def _turned_away(keyframes: Sequence[int]) -> dict[int, np.ndarray]:
    """Return a rotation [4, 4] about the vertical axis per keyframe id, away from the camera.

    The angles are evenly spread from a quarter to three quarters of a turn.
    """
    angles = np.linspace(0.5 * np.pi, 1.5 * np.pi, max(len(keyframes), 2))
    return {
        keyframe: se3.exp(np.array([0, angle, 0, 0, 0, 0]))
        for keyframe, angle in zip(keyframes, angles, strict=False)
    }
