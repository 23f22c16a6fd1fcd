"""Self-test of the alignment on a GPU: a small scene, compared with the CPU."""

import numpy as np

from ldo_service.errors import DeviceError
from ldo_service.geometry import Camera, se3
from ldo_service.kernels.gpu.arrays import Arrays

from .alignment import (
    AlignConfig,
    BrightnessModel,
    Linearizer,
    ResidualConfig,
    align,
    normal_equations,
)
from .gpu_equations import GpuEquations
from .pyramid import Pyramid, PyramidConfig, ReferencePoints, build_pyramid, build_reference

# Number of repetitions that must give the same bits. A race between threads of a GPU may show in
# few of them.
REPEATS = 20
WIDTH_PX, HEIGHT_PX = 48, 36  # The finest level has about 1,500 points.
XI = np.array([0.004, -0.006, 0.003, 0.01, -0.008, 0.012])  # Motion of the camera.
APPEARANCE = BrightnessModel(gain=0.9, bias=5.0, intensity_sigma=6.0, depth_noise_scale=1.5)
# Largest differences that rounding explains. Triton's interpreter was compared with all three
# instruction sets of the CPU: the differences are below a fifth of each limit.
TOLERANCE = {
    "hessian": 1e-6,  # Relative to the norm, in units of the square roots of the diagonal.
    "gradient": 1e-6,
    "gradients by cell": 5e-6,
    "statistics": 1e-6,
    "pose": 1e-6,  # Radians and meters.
    "information": 2e-4,
    "quality": 1e-5,
}
Outcome = dict[str, np.ndarray]


def run_self_test(arrays: Arrays, repeats: int = REPEATS) -> None:
    """Check that a GPU computes the same normal equations and alignment as the CPU.

    Args:
        arrays: Access to the arrays of the GPU.
        repeats: Number of times that the GPU repeats the computation, at least 1.

    Raises:
        DeviceError: The GPU fails, or its results differ from those of the CPU or between
            repetitions.
    """
    scene = make_scene(WIDTH_PX, HEIGHT_PX)
    wanted, first = outcome(scene, normal_equations), None
    for _ in range(repeats):
        got = outcome(scene, GpuEquations(arrays).normal_equations)
        if first is None:
            first = got
            require_equal(got, wanted)
        elif not all(np.array_equal(got[k], v, equal_nan=True) for k, v in first.items()):
            raise DeviceError("the results of the self-test differ between two repetitions.")


def make_scene(width: int, height: int) -> tuple[ReferencePoints, Pyramid]:
    """Return the reference points of a surface, and a second image of the same surface.

    The surface is a textured slope with a step. For the second image, the camera has moved slightly
    and the gray levels are lower. The depth of both images has holes.

    Args:
        width: Width of the image, pixels.
        height: Height of the image, pixels.
    """
    rng = np.random.default_rng(0)
    focal_px = 0.8 * width
    camera = Camera(width, height, focal_px, focal_px, (width - 1) / 2, (height - 1) / 2)
    pyramids = []
    for moved, gain in ((0.0, 1.0), (0.4, 0.9)):
        v, u = np.mgrid[:height, :width].astype(np.float32)
        u, v = (u + moved) * (48 / width), (v - moved) * (48 / width)
        depth_m = 1.5 + 0.006 * u + 0.004 * v + 0.4 * (u > 30)
        depth_m += rng.normal(0, 0.001, depth_m.shape)
        depth_m[rng.uniform(size=depth_m.shape) < 0.1] = 0
        gray = 110 + 50 * np.sin(0.5 * u + 0.2 * v) * np.cos(0.4 * v)
        gray = gain * gray + rng.normal(0, 2, gray.shape)
        gray[u + v < 12] = 255
        image = gray.clip(0, 255).astype(np.uint8)
        config = PyramidConfig(working_width_px=width, levels=2)
        pyramids.append(build_pyramid(image, depth_m.astype(np.float32), camera, config))
    return build_reference(pyramids[0]), pyramids[1]


def outcome(scene: tuple[ReferencePoints, Pyramid], linearize: Linearizer) -> Outcome:
    """Return the normal equations and the alignment for a scene, as arrays by name."""
    reference, frame = scene
    points, target = reference.points[0], frame.levels[0]
    T = se3.exp(XI)
    e = linearize(points, target, T, APPEARANCE, ResidualConfig(), reference.cells)
    found = align(reference, frame, T, AlignConfig(), linearize)
    statistics = [(s.count, s.inliers, s.square) for s in (e.photometric, e.geometric)]
    fractions = found.photometric_inliers, found.geometric_inliers, found.overlap, found.paired
    brightness = found.gain, found.bias, found.intensity_sigma, found.depth_noise_scale
    return {
        "hessian": e.hessian,
        "gradient": e.gradient,
        "gradients by cell": e.cells,
        "statistics": np.array([(e.visible, 0, 0), *statistics]),
        "pose": found.T_reference_camera,
        "information": found.information,
        "quality": np.array([*fractions, *brightness]),
    }


def require_equal(got: Outcome, wanted: Outcome) -> None:
    """Check the results of a GPU.

    Raises:
        DeviceError: The results of the GPU differ from those of the CPU.
    """
    for name, difference in differences(got, wanted).items():
        if not difference <= TOLERANCE[name]:  # NaN is above every limit.
            raise DeviceError(
                f"{name} differs by {difference:.1e} from the CPU result; at most "
                f"{TOLERANCE[name]:.0e} is allowed."
            )


def differences(got: Outcome, wanted: Outcome) -> dict[str, float]:
    """Return the differences of two results by name; see TOLERANCE."""
    unit = np.sqrt(np.diag(wanted["hessian"]))
    of_pose = np.sqrt(np.diag(wanted["information"]))
    units = {"hessian": np.outer(unit, unit), "information": np.outer(of_pose, of_pose)}
    units |= {"gradient": unit, "gradients by cell": unit}
    found = {}
    for name, value in wanted.items():
        one, other = (x / units.get(name, 1.0) for x in (got[name], value))
        size = 1.0 if name == "pose" else np.linalg.norm(other) or 1.0
        found[name] = float(np.linalg.norm(one - other) / size)
    return found
