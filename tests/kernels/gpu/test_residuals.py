"""Normal equations of the alignment: kernels against C++ and the reference implementation."""

from dataclasses import dataclass, field, replace
from functools import cache
from itertools import product

import numpy as np
import pytest

from ldo_service.geometry import Camera, se3
from ldo_service.kernels import _align
from ldo_service.kernels.gpu.arrays import Arrays
from ldo_service.tracking.alignment import (
    BrightnessModel,
    NormalEquations,
    ResidualConfig,
    normal_equations,
)
from ldo_service.tracking.pyramid import Level
from tests.kernels.gpu.agreement import check
from tests.kernels.gpu.scenes import ARRAYS, equation_sums
from tests.reference import alignment

CAMERA = Camera(32, 24, 30.0, 29.0, 15.0, 12.5)
APPEARANCE = BrightnessModel(gain=1.05, bias=-2.0, intensity_sigma=7.0, depth_noise_scale=1.5)


@dataclass(frozen=True, eq=False)
class Scene:
    """Reference points and a frame at a pose."""

    points: np.ndarray  # [7, N]
    target: Level
    T_camera_reference: np.ndarray
    cells: np.ndarray  # [N]
    appearance: BrightnessModel = APPEARANCE
    config: ResidualConfig = field(default_factory=ResidualConfig)

    @property
    def arguments(self) -> tuple:
        pose, noise = self.T_camera_reference, self.appearance
        return self.points, self.target, pose, noise, self.config

    def of(self, chosen: np.ndarray) -> "Scene":
        """Return the scene with some of the points."""
        points = np.ascontiguousarray(self.points[:, chosen])
        return replace(self, points=points, cells=self.cells[chosen])


def surface(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return gray levels and depth in meters of a textured slope with noise."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width].astype(np.float32)
    depth_m = 1.5 + 0.01 * u + 0.008 * v + rng.normal(0, 0.002, u.shape)
    gray = 120 + 50 * np.sin(0.6 * u) * np.cos(0.3 * v) + rng.normal(0, 4, u.shape)
    return gray.astype(np.float32), depth_m.astype(np.float32)


def scene_of(xi: tuple[float, ...], *, has_holes: bool = False) -> Scene:
    """Return a scene at a pose; holes are missing depth, clipped pixels, and a nearer object."""
    intrinsics = CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy
    gray, depth_m = surface(0)
    texels = _align.pack(gray, depth_m, 30.0)
    normals = _align.normals(depth_m, intrinsics, 2)
    points = _align.points(texels, normals, intrinsics)
    gray, depth_m = surface(1)
    if has_holes:
        depth_m[4:9, 3:14], gray[10:14, 5:20] = 0, 0
        depth_m[15:20, 8:18] *= 0.7  # It hides the points behind it.
        depth_m[2:12, 22:28] *= 1.2  # The gate excludes these depths.
    target = Level(_align.pack(gray, depth_m, 30.0), CAMERA)
    cells = np.random.default_rng(2).integers(0, 5, points.shape[1]).astype(np.uint8)
    return Scene(points, target, se3.exp(np.array(xi)), cells)


def with_points_behind(scene: Scene) -> Scene:
    """Return a scene with points behind the camera and too close to it, at pixels of the image."""
    points, T_reference_camera = scene.points.copy(), se3.inverse(scene.T_camera_reference)
    rays = points[:3] / points[2]
    for first, z in ((0, -1.0), (1, 5e-4)):
        points[:3, first::5] = se3.transform(T_reference_camera, z * rays[:, first::5].T).T
    return replace(scene, points=points)


SCENES = {
    "slope": scene_of((0.002, -0.003, 0.001, 0.02, -0.01, 0.015)),
    "holes": scene_of((0.002, 0.001, -0.002, 0.01, 0.01, -0.005), has_holes=True),
    "partly outside": scene_of((0.1, -0.25, 0.15, 0.3, -0.1, 0.2)),
    "partly behind the camera": with_points_behind(
        scene_of((0.002, -0.003, 0.001, 0.02, -0.01, -0.015))
    ),
    "other noise": replace(
        scene_of((0.002, -0.003, 0.001, 0.02, -0.01, 0.015)),
        appearance=BrightnessModel(0.8, 20.0, 2.0, 0.3),
    ),
}
# Scenes without a visible point.
INVISIBLE = {
    "behind the camera": scene_of((0.0, 0.0, 0.0, 0.0, 0.0, -3.0)),
    "outside the image": scene_of((0.0, 0.0, 0.0, 10.0, 0.0, 0.0)),
    "no points": SCENES["slope"].of(np.zeros(0, int)),
}


def equations_of(arrays: Arrays, scene: Scene, *, with_cells: bool = True) -> NormalEquations:
    from ldo_service.tracking.gpu_equations import GpuEquations  # It imports Triton.

    cells = scene.cells if with_cells else None
    return GpuEquations(arrays).normal_equations(*scene.arguments, cells)


def numbers_of(e: NormalEquations) -> list[np.ndarray]:
    """Return all results as arrays."""
    statistics = [(s.count, s.inliers, s.square) for s in (e.photometric, e.geometric)]
    return [e.hessian, e.gradient, np.array([(e.visible, 0, 0), *statistics]), e.cells]


@cache
def of_kernel(name: str) -> NormalEquations:
    return equations_of(ARRAYS, SCENES[name])


def compare(got: NormalEquations, wanted: NormalEquations, other: str, where: str) -> None:
    unit = np.sqrt(np.diag(wanted.hessian))
    error = np.abs((got.hessian - wanted.hessian) / np.outer(unit, unit)).max()
    check(f"normal equations to {other}", error, f"{where}, Hessian")
    scale = np.abs(wanted.gradient / unit).max()
    error = np.abs((got.gradient - wanted.gradient) / unit).max() / scale
    check(f"normal equations to {other}", error, f"{where}, gradient")
    assert got.visible == wanted.visible
    for ours, theirs in ((got.photometric, wanted.photometric), (got.geometric, wanted.geometric)):
        assert (ours.count, ours.inliers) == (theirs.count, theirs.inliers)
        error = abs(ours.square - theirs.square) / theirs.square
        check(f"normal equations to {other}", error, f"{where}, squares")


@pytest.mark.parametrize("name", SCENES)
def test_equations_equal_those_of_the_cpu(name: str) -> None:
    got, wanted = of_kernel(name), normal_equations(*SCENES[name].arguments, SCENES[name].cells)
    assert 20 < got.geometric.count <= got.visible
    compare(got, wanted, "C++", name)
    np.testing.assert_array_equal(got.hessian, got.hessian.T)
    error = np.abs(got.cells - wanted.cells) / np.sqrt(np.diag(wanted.hessian))
    size = np.abs(wanted.cells / np.sqrt(np.diag(wanted.hessian))).max()
    check("gradients by cell to C++", error.max() / size, name)


@pytest.mark.parametrize("name", SCENES)
def test_equations_equal_the_reference(name: str) -> None:
    scene, got = SCENES[name], of_kernel(name)
    wanted = alignment.normal_equations(*scene.arguments)
    compare(got, wanted, "reference", name)
    strips = np.arange(len(scene.cells)) // 16
    of_strip = equation_sums.strip_cells(scene.cells)[strips]
    texels = scene.target.texels.copy()
    texels[..., 0] = 0
    dark, unit = replace(scene, target=Level(texels, CAMERA)), np.sqrt(np.diag(wanted.hessian))
    for cell in range(6):
        both, geometric = (
            alignment.normal_equations(*part.of(of_strip == cell).arguments).gradient
            for part in (scene, dark)
        )
        by_kind = np.array([both - geometric, geometric])
        error = np.abs((got.cells[cell] - by_kind) / unit).max()
        check("gradients by cell to reference", error / np.abs(got.cells / unit).max(), name)
    assert not got.cells[5:].any()


@pytest.mark.parametrize("name", INVISIBLE)
def test_equations_without_a_visible_point_are_zero(name: str) -> None:
    got = equations_of(ARRAYS, INVISIBLE[name])
    assert not any(values.any() for values in numbers_of(got))
    assert got.cells.shape == (64, 2, 8)


def test_cells_do_not_change_the_equations() -> None:
    without = equations_of(ARRAYS, SCENES["holes"], with_cells=False)
    assert without.cells.shape == (0, 2, 8)
    for one, other in zip(numbers_of(without)[:3], numbers_of(of_kernel("holes")), strict=False):
        np.testing.assert_array_equal(one, other)


def test_points_that_are_not_finite_add_nothing() -> None:
    """The kernel excludes coordinates, gray levels and normals that are not finite."""
    scene = SCENES["slope"]
    points, without = scene.points.copy(), scene.points.copy()
    rows, values = (0, 2, 3, 5), (np.nan, np.inf, -np.inf)
    for first, (row, value) in enumerate(product(rows, values)):
        bad = slice(first, None, 20)
        points[row, bad] = value
        # A point behind the camera is not visible; 0 marks a missing gray level or normal.
        without[{0: 2, 2: 2, 3: 3, 5: slice(4, 7)}[row], bad] = 0
    got = equations_of(ARRAYS, replace(scene, points=points))
    wanted = equations_of(ARRAYS, replace(scene, points=without))
    assert 300 < got.geometric.count < got.photometric.count < got.visible < 600
    for one, other in zip(numbers_of(got), numbers_of(wanted), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("n", [1, 15, 16, 17, 129])
def test_any_number_of_points_is_summed(n: int) -> None:
    scene = SCENES["slope"].of(np.arange(200, 200 + n))
    got, wanted = equations_of(ARRAYS, scene), normal_equations(*scene.arguments, scene.cells)
    assert 0.9 * n < got.visible == wanted.visible
    for one, other in zip(numbers_of(got), numbers_of(wanted), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-6 * np.abs(other).max())
