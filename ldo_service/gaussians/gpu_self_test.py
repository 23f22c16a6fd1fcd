"""Self-test of the GPU backend: iterations and a rendering of a small scene, as on the CPU."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from ldo_service.errors import DeviceError
from ldo_service.geometry import Camera
from ldo_service.kernels.gpu.arrays import Arrays

from .adam import AdamConfig
from .exposure import Exposure
from .gpu_backend import GpuBackend
from .loss import LossWeights
from .model import GaussianMap
from .optimizer_backend import CpuBackend, OptimizerBackend, ShapeLimits
from .renderer import Rasterizer
from .rows import ROW
from .training_views import TrainingView

# Number of repetitions that must give the same bits. A race between threads of a GPU may show in
# few of them.
REPEATS = 20
SIDE_PX = 40  # Nine tiles, and enough blocks for the estimate of the exposure.
GAUSSIANS = 60  # They have about 200 pairs with a tile.
WALL = 8  # Number of these Gaussians that are large and opaque, behind the others.
ADAM, WEIGHTS = AdamConfig(), LossWeights()
LIMITS = ShapeLimits(needle_weight=0.01, max_needle_ratio=1.5, max_sigma_px=4.0)
COLUMNS = {"position": (0, 3), "scale": (3, 6), "rotation": (6, 10), "opacity": (10, 11)}
COLUMNS["color"] = (11, 14)
# Largest differences that rounding explains, relative to the norm of the CPU's values. The
# largest ones that the interpreter of Triton gave on this scene, compared with all three
# instruction sets of the CPU, are below a fifth of each limit.
TOLERANCE = {"loss": 1e-5, "weights": 1e-6, "exposure": 1e-6, "moments": 2e-5, "pose": 1e-5}
TOLERANCE |= {"step": 2e-6, "color": 1e-6, "depth": 1e-6, "opacity": 1e-6}
# Largest fraction of the Gaussians that rounding makes visible on one of the devices alone, and of
# the pixels with another Gaussian on top or at the median depth. The self-test has none of them.
MAX_BORDERLINE = 1e-3
SAME_DEPTH = 1e-5  # Median depths of the same Gaussian differ less, relative to the depth.
# A derivative below this fraction of the largest one in its column may have either sign, and the
# first step of Adam depends on the sign alone. Its step is not compared.
CLEAR_RATIO = 1e-2


@dataclass(frozen=True, eq=False, slots=True)
class Outcome:
    """Results of one iteration or rendering, by name; rows have the order of the map."""

    values: dict[str, np.ndarray]

    def same_bits(self, other: "Outcome") -> bool:
        """Return whether all results are bitwise equal."""
        return all(
            np.array_equal(v, other.values[k], equal_nan=True) for k, v in self.values.items()
        )


Run = Callable[[OptimizerBackend], Outcome]


def run_self_test(arrays: Arrays, repeats: int = REPEATS) -> None:
    """Iterate and render on the CPU once and on the GPU several times, and compare the results.

    Args:
        arrays: Array operations on the GPU.
        repeats: Number of runs on the GPU, at least 1.

    Raises:
        DeviceError: The GPU fails, its results differ from those of the CPU, or its results differ
            between two runs.
    """
    rows, view = _scene()
    runs: list[tuple[Run, Callable[[Outcome, Outcome], None]]] = [
        (partial(iterate, rows=rows, view=view, is_half=False), require_equal),
        (partial(iterate, rows=rows, view=view, is_half=True), require_equal),
        (partial(render_view, rows=rows, view=view), require_equal_view),
    ]
    for run, require in runs:
        wanted = run(CpuBackend(ADAM, WEIGHTS, LIMITS))
        first: Outcome | None = None
        for _ in range(repeats):
            got = run(GpuBackend(arrays, ADAM, WEIGHTS, LIMITS))
            if first is None:
                require(got, wanted)
            elif not got.same_bits(first):
                raise DeviceError(
                    "the results of the self-test differ between two repetitions. Use the CPU."
                )
            first = first or got


def _scene() -> tuple[np.ndarray, TrainingView]:
    """Return Gaussians [GAUSSIANS, 16], and a darker image of them with noise and holes."""
    rng = np.random.default_rng(0)
    rows, z = np.zeros((GAUSSIANS, ROW), np.float32), rng.uniform(1, 2, GAUSSIANS)
    rows[:, :3] = np.column_stack([rng.uniform(-0.5, 0.5, (GAUSSIANS, 2)) * z[:, None], z])
    rows[:, 3:6] = np.log(z[:, None] * rng.uniform(0.02, 0.15, (GAUSSIANS, 3)))
    rows[:, 6:10] = rng.normal(size=(GAUSSIANS, 4))
    rows[:, 10] = rng.uniform(-1, 3, GAUSSIANS)
    rows[:, 11:14] = rng.uniform(0.2, 0.9, (GAUSSIANS, 3))
    rows[:WALL, :3] *= 2.5 / z[:WALL, None]
    rows[:WALL, 3:6], rows[:WALL, 10] = np.log(0.8), 6
    camera = Camera(SIDE_PX, SIDE_PX, SIDE_PX, SIDE_PX, SIDE_PX / 2, SIDE_PX / 2)
    planes = Rasterizer().render(rows, camera, np.eye(4))
    noise = rng.uniform(-40, 40, (3, SIDE_PX, SIDE_PX))
    color = (0.8 * 255 * planes[:3] + noise).clip(0, 255).astype(np.uint8)
    depth_m = rng.uniform(1, 2, (SIDE_PX, SIDE_PX)).astype(np.float32)
    depth_m[rng.uniform(size=depth_m.shape) < 0.2] = 0
    mask = np.ones(depth_m.shape, np.uint8)
    mask[-3:] = 0
    return rows, TrainingView(0, camera, color, depth_m, np.eye(4), mask=mask)


def iterate(
    backend: OptimizerBackend, rows: np.ndarray, view: TrainingView, is_half: bool = False
) -> Outcome:
    """Run one iteration of a new backend on Gaussians [N, 16], and return its results."""
    gaussians = GaussianMap(len(rows))
    gaussians.add(rows, 0)
    backend.begin(gaussians)
    backend.render(view, is_half=is_half)
    exposure = backend.estimate_exposure()
    loss, visible = backend.descend(exposure or Exposure(), rate=lambda _: 1.0)
    backend.end()
    state, weights = backend.snapshot(), np.zeros(len(rows), np.float32)
    weights[visible.indices] = visible.weights
    matrix = np.zeros((2, 3)) if exposure is None else exposure.matrix
    return Outcome(
        {
            "loss": np.array([loss.total, loss.l1, loss.d_ssim, loss.depth_m]),
            "weights": weights,
            "pose": np.array(visible.xi),
            "exposure": matrix,
            "moments": state["mean"],
            "squares": state["square"],
            "steps": state["steps"],
            "step": gaussians.rows - rows,
        }
    )


def require_equal(got: Outcome, wanted: Outcome) -> None:
    """Check that the results of a GPU equal those of the CPU, apart from rounding.

    Raises:
        DeviceError: The results differ by more than rounding explains.
    """
    changed = np.mean(got.values["steps"] != wanted.values["steps"])
    if changed > MAX_BORDERLINE:
        raise DeviceError(
            f"{changed:.1%} of the Gaussians are visible on the GPU but not on the CPU, or the "
            f"reverse. At most {MAX_BORDERLINE:.1%} is allowed. Use the CPU."
        )
    _require_within_tolerance(differences(got, wanted))


def render_view(backend: OptimizerBackend, rows: np.ndarray, view: TrainingView) -> Outcome:
    """Render Gaussians [N, 16] at the pose of a view, and return the images and contributions."""
    gaussians = GaussianMap(len(rows))
    gaussians.add(rows, 0)
    shown = backend.render_view(gaussians, view.camera, view.T_map_camera, contributions=True)
    made_by, weights = shown.contributions, np.zeros(len(rows), np.float32)
    assert made_by is not None
    weights[made_by.indices] = made_by.weights
    return Outcome(
        {
            "color": shown.color,
            "depth": shown.weighted_depth_m,
            "opacity": shown.opacity,
            "weights": weights,
            "median depth": shown.median_depth_m,
            "top": made_by.top,
        }
    )


def require_equal_view(got: Outcome, wanted: Outcome) -> None:
    """Check that a rendering of a GPU equals that of the CPU, apart from rounding.

    Raises:
        DeviceError: The results differ by more than rounding explains.
    """
    depth_m, wanted_m = got.values["median depth"], wanted.values["median depth"]
    is_other = ~(np.abs(depth_m - wanted_m) <= SAME_DEPTH * wanted_m)
    is_other |= got.values["top"] != wanted.values["top"]
    if is_other.mean() > MAX_BORDERLINE:
        raise DeviceError(
            f"{is_other.mean():.1%} of the pixels have another median depth or top Gaussian than "
            f"on the CPU. At most {MAX_BORDERLINE:.1%} is allowed. Use the CPU."
        )
    names = "color", "depth", "opacity", "weights"
    _require_within_tolerance({k: _relative(got.values[k], wanted.values[k]) for k in names})


def _require_within_tolerance(differences: dict[str, float]) -> None:
    for name, difference in differences.items():
        limit = TOLERANCE[name.partition(" ")[0]]
        if not difference <= limit:  # NaN is above every limit.
            raise DeviceError(
                f"{name} differs by a relative {difference:.1e} from the CPU; at most {limit:.0e} "
                "is allowed. Use the CPU."
            )


def differences(got: Outcome, wanted: Outcome) -> dict[str, float]:
    """Return the relative difference of each result: norm(got - wanted) / norm(wanted)."""
    pairs = {k: (got.values[k], wanted.values[k]) for k in ("loss", "weights", "pose", "exposure")}
    of_moments, of_steps = ([o.values[k] for o in (got, wanted)] for k in ("moments", "step"))
    for name, (first, last) in COLUMNS.items():
        columns = slice(first, last)
        moments = of_moments[1][:, columns]
        pairs[f"moments of {name}"] = of_moments[0][:, columns], moments
        is_clear = np.abs(moments) > CLEAR_RATIO * np.abs(moments).max(axis=0)
        got_step, step = (step[:, columns][is_clear] for step in of_steps)
        pairs[f"step of {name}"] = got_step, step
    return {name: _relative(*pair) for name, pair in pairs.items()}


def _relative(got: np.ndarray, wanted: np.ndarray) -> float:
    return float(np.linalg.norm(got - wanted) / (np.linalg.norm(wanted) or 1))
