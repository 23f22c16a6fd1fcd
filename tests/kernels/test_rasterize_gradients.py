"""Tests of the backward kernel against the float64 derivative of the reference.

They run with every instruction set that this machine has.
"""

import threading
from collections.abc import Callable

import autograd.numpy as anp
import numpy as np
import pytest
from autograd import grad

from ldo_service.gaussians.renderer import Rasterizer
from ldo_service.geometry import Camera, se3
from ldo_service.kernels import _rasterize
from tests.reference.render import render_reference

from .scenes import camera_of, gaussians

GROUPS = {
    "mean": slice(0, 3),
    "log_scale": slice(3, 6),
    "quat": slice(6, 10),
    "opacity": slice(10, 11),
    "color": slice(11, 14),
}
DIFFERENTIATE_ALL = """
from ldo_service.gaussians.renderer import Rasterizer
from ldo_service.geometry import Camera
for name in {key.split("/")[0] for key in given}:
    rows, T, camera, by_planes = (given[f"{name}/{part}"] for part in ("rows", "T", "camera", "by"))
    rasterizer = Rasterizer(threads=2)
    camera = Camera(int(camera[0]), int(camera[1]), *camera[2:])
    binning = int(given[f"{name}/binning"])
    result[f"{name}/planes"] = rasterizer.render(rows, camera, T, binning=binning)
    gradients = rasterizer.gradients(by_planes)
    result[f"{name}/rows"] = np.zeros_like(rows)
    result[f"{name}/rows"][gradients.indices] = gradients.rows
    result[f"{name}/xi"] = gradients.xi
"""


def nearly_opaque() -> np.ndarray:
    """Return Gaussians with alpha above the cap of 0.99 in the middle, where only color matters."""
    rows = gaussians(60, 3)
    rows[:, 10] = 8
    return rows


TURNED = se3.exp(np.array([0.2, -0.3, 0.1, 0.1, -0.2, 0.3]))
SCENES = {
    "many": (gaussians(120, 0), camera_of(28, 20), np.eye(4)),
    "turned_camera": (gaussians(120, 1), camera_of(28, 20), TURNED),
    "odd_size": (gaussians(100, 6), camera_of(17, 23), TURNED),
    "straddling_the_camera": (gaussians(120, 2, depth_m=(-2, 2)), camera_of(20, 20), np.eye(4)),
    "nearly_opaque": (nearly_opaque(), camera_of(20, 20), np.eye(4)),
    "one_pixel": (gaussians(40, 5), camera_of(1, 1), np.eye(4)),
    "binned": (gaussians(120, 8), camera_of(28, 20), TURNED),
    "nothing": (gaussians(0, 7), camera_of(9, 9), np.eye(4)),
}


def by_planes_of(camera: Camera) -> np.ndarray:
    """Return random derivatives with respect to the planes, [5, H, W]."""
    rng = np.random.default_rng(camera.width)
    return rng.normal(size=(5, camera.height, camera.width)).astype(np.float32)


def loss(rows: np.ndarray, camera: Camera, T: np.ndarray, binning: int = 1) -> float:
    """Compute sum(G * planes), so that G is the gradient by the planes."""
    G, seen = by_planes_of(camera), render_reference(rows, camera, T, anp, binning)
    by_color = anp.sum(np.moveaxis(G[:3], 0, -1) * seen.color)
    return by_color + anp.sum(G[3] * seen.weighted_depth_m) + anp.sum(G[4] * seen.opacity)


def binning_of(scene: str) -> int:
    return 2 if scene == "binned" else 1


def as_kernel_sees(T: np.ndarray) -> np.ndarray:
    """Round a transform to float32, like the kernel."""
    return T.astype(np.float32).astype(float)


@pytest.fixture(scope="module")
def by_kernel(with_isa: Callable) -> dict[str, np.ndarray]:
    """Return the planes and gradients of every scene, computed by the kernel."""
    given = {}
    for name, (rows, c, T) in SCENES.items():
        given[f"{name}/rows"], given[f"{name}/T"] = rows, T
        given[f"{name}/camera"] = np.array([c.width, c.height, c.fx, c.fy, c.cx, c.cy])
        given[f"{name}/by"] = by_planes_of(c)
        given[f"{name}/binning"] = np.array(binning_of(name))
    return with_isa(DIFFERENTIATE_ALL, given)


@pytest.fixture(scope="module")
def by_reference() -> dict[str, np.ndarray]:
    """Return the derivatives with respect to the rows of every scene, by the reference code."""
    return {
        name: grad(loss)(rows.astype(float), camera, as_kernel_sees(T), binning_of(name))
        for name, (rows, camera, T) in SCENES.items()
        if len(rows)
    }


@pytest.mark.parametrize("scene", [name for name in SCENES if name != "nothing"])
def test_row_gradients_agree_with_the_derivative_of_the_plain_twin(
    scene: str, by_kernel: dict, by_reference: dict
) -> None:
    for name, fields in GROUPS.items():
        wanted = by_reference[scene][:, fields]
        error = np.linalg.norm(by_kernel[f"{scene}/rows"][:, fields] - wanted)
        assert error <= 1e-5 * np.linalg.norm(wanted), name


@pytest.mark.parametrize(
    "scene", ["many", "turned_camera", "odd_size", "straddling_the_camera", "binned"]
)
def test_pose_gradient_agrees_with_finite_differences(scene: str, by_kernel: dict) -> None:
    rows, camera, T = SCENES[scene]
    T_map_camera = se3.inverse(as_kernel_sees(T))

    def loss_at(xi: np.ndarray) -> float:
        T_camera_map = se3.inverse(T_map_camera @ se3.exp(xi))
        return loss(rows.astype(float), camera, T_camera_map, binning_of(scene))

    steps = 1e-6 * np.eye(6)
    expected = np.array([(loss_at(step) - loss_at(-step)) / 2e-6 for step in steps])
    error = np.linalg.norm(by_kernel[f"{scene}/xi"] - expected)
    assert error <= 2e-5 * np.linalg.norm(expected)


def test_view_of_nothing_has_no_gradients(by_kernel: dict) -> None:
    assert by_kernel["nothing/rows"].shape == (0, 16)
    assert not by_kernel["nothing/xi"].any()
    assert not by_kernel["nothing/planes"].any()


def test_planes_are_the_images_of_the_rasterizer() -> None:
    rows, camera, T = SCENES["odd_size"]
    planes = Rasterizer().render(rows, camera, T)
    intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
    color, depth_m, _, opacity = _rasterize.rasterize(rows, T[:3].astype(np.float32), *intrinsics)
    np.testing.assert_allclose(planes[:3], np.moveaxis(color, -1, 0), atol=1e-6)
    np.testing.assert_allclose(planes[3], depth_m, atol=1e-5)
    np.testing.assert_allclose(planes[4], opacity, atol=1e-6)


def test_binned_splat_is_the_mean_of_blocks_of_the_full_image() -> None:
    rows = gaussians(1, 9)
    rows[0, :3] = 0.013, -0.02, 2.0
    rows[0, 3:6] = np.log(2.0 * np.array([2.0, 1.2, 1.5]) / 60)  # 1.2 to 2 px.
    camera = Camera(48, 40, 60.0, 60.0, 23.5, 19.5)
    full = Rasterizer().render(rows, camera, np.eye(4)).copy()
    means = full.reshape(5, 20, 2, 24, 2).mean(axis=(2, 4))
    binned = Rasterizer().render(rows, camera.halved(), np.eye(4), binning=2)
    assert means[4].max() > 0.2
    assert np.abs(binned - means).max() < 0.01 * means[4].max()
    as_full = Rasterizer().render(rows, camera.halved(), np.eye(4))
    assert np.abs(as_full - means).max() > 0.03 * means[4].max()


def test_early_stop_leaves_out_the_same_splats_forward_and_backward() -> None:
    rows = gaussians(1500, 8)
    rows[:, 10] = 3
    camera = camera_of(24, 24)
    rasterizer = Rasterizer()
    planes = rasterizer.render(rows, camera, np.eye(4))
    gradients = rasterizer.gradients(np.ones((5, 24, 24), np.float32))
    assert np.mean(planes[4] > 0.9999) > 0.9
    hidden = gradients.rows[:, 14] == 0
    assert 0.1 < hidden.mean() < 0.9
    assert not gradients.rows[hidden].any()
    # The sum of weights over Gaussians is the sum of opacities over pixels.
    np.testing.assert_allclose(gradients.rows[:, 14].sum(), planes[4].sum(), rtol=1e-5)


def test_needle_penalty_shortens_the_longest_axis_and_widens_the_middle_one() -> None:
    rows = gaussians(40, 11)
    rows[:, 3:6] = np.log([0.5, 0.05, 0.01])
    rows[20:, 3:6] = np.log([0.01, 0.06, 0.05])  # A disc, below the ratio.
    rasterizer = Rasterizer()
    rasterizer.render(rows, camera_of(24, 24), np.eye(4))
    gradients = rasterizer.gradients(
        np.zeros((5, 24, 24), np.float32), needle_weight=2.0, needle_ratio=4.0
    )
    needles = gradients.indices < 20
    push = 2.0 * gradients.rows[:, 14:15] / 24**2
    assert push[needles].max() > 0
    np.testing.assert_allclose(
        gradients.rows[needles, 3:6], (push * [1, -1, 0])[needles], rtol=1e-6
    )
    assert not gradients.rows[~needles, :14].any()


@pytest.mark.parametrize("threads", [2, 3, 7])
def test_number_of_threads_changes_no_bit(threads: int) -> None:
    rows, camera = gaussians(30_000, 9), camera_of(213, 157)
    results = []
    for n in (1, threads):
        rasterizer = Rasterizer(threads=n)
        planes = rasterizer.render(rows, camera, TURNED).copy()
        gradients = rasterizer.gradients(by_planes_of(camera))
        results.append([planes, gradients.indices, gradients.rows, gradients.xi])
    for one, many in zip(*results, strict=True):
        assert one.tobytes() == many.tobytes()


def test_memory_of_a_larger_view_does_not_change_the_next() -> None:
    rows, camera, T = SCENES["many"]
    used, fresh = Rasterizer(), Rasterizer()
    used.render(gaussians(20_000, 1), camera_of(160, 120), np.eye(4))
    used.gradients(by_planes_of(camera_of(160, 120)))
    assert used.render(rows, camera, T).tobytes() == fresh.render(rows, camera, T).tobytes()
    one, other = (r.gradients(by_planes_of(camera)) for r in (used, fresh))
    assert one.rows.tobytes() == other.rows.tobytes()
    assert one.xi.tobytes() == other.xi.tobytes()


def test_pass_that_another_thread_uses_is_refused() -> None:
    rows, forward = gaussians(200_000, 0), _rasterize.Pass()
    T, planes = np.eye(4, dtype=np.float32)[:3], np.zeros((5, 480, 640), np.float32)
    arguments = (forward, rows, T, 500.0, 500.0, 320.0, 240.0, planes)
    refused = []

    def render_often() -> None:
        for _ in range(20):
            try:
                _rasterize.rasterize_planes(*arguments)
            except ValueError as error:
                refused.append(str(error))

    threads = [threading.Thread(target=render_often) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert refused
    assert all("in use by another thread" in message for message in refused)


def rendered(n: int = 5) -> tuple[_rasterize.Pass, dict]:
    """Render n rows and return the pass with valid arguments of `backpropagate`."""
    rows, forward, planes = gaussians(n, 0), _rasterize.Pass(), np.zeros((5, 9, 9), np.float32)
    T = np.eye(4, dtype=np.float32)[:3]
    visible = _rasterize.rasterize_planes(forward, rows, T, 9.0, 9.0, 4.0, 4.0, planes)
    return forward, {
        "rows": rows,
        "planes": planes,
        "gradients": np.ones_like(planes),
        "indices": np.zeros(visible, np.uint32),
        "row_gradients": np.zeros((visible, 16), np.float32),
    }


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rows": gaussians(4, 0)}, "not those that were rendered"),
        ({"planes": np.zeros((5, 9, 8), np.float32)}, r"\[5, 9, 9\]"),
        ({"gradients": np.zeros((5, 9, 9))}, "float32"),
        ({"gradients": np.zeros((4, 9, 9), np.float32)}, r"\[5, 9, 9\]"),
        ({"indices": np.zeros(99, np.uint32)}, "indices"),
        ({"row_gradients": np.zeros((1, 16), np.float32)}, "row_gradients"),
        ({"threads": 0}, "threads"),
        ({"needle_weight": -1.0}, "needle"),
    ],
)
def test_bad_arguments_raise_value_error(change: dict, message: str) -> None:
    forward, arguments = rendered()
    assert len(arguments["indices"]) > 1
    _rasterize.backpropagate(forward, **arguments)
    with pytest.raises(ValueError, match=message):
        _rasterize.backpropagate(forward, **arguments | change)


@pytest.mark.parametrize("binning", [0, 3])
def test_binning_other_than_1_or_2_is_refused(binning: int) -> None:
    rows, planes = gaussians(3, 0), np.zeros((5, 9, 9), np.float32)
    T = np.eye(4, dtype=np.float32)[:3]
    with pytest.raises(ValueError, match="binning must be 1 or 2"):
        _rasterize.rasterize_planes(
            _rasterize.Pass(), rows, T, 9.0, 9.0, 4.0, 4.0, planes, binning=binning
        )


def test_gradients_before_any_rendering_are_refused() -> None:
    _, arguments = rendered()
    with pytest.raises(ValueError, match="no rendering"):
        _rasterize.backpropagate(_rasterize.Pass(), **arguments)
