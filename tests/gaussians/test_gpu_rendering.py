"""Renderings of the map by the GPU backend in the interpreter of Triton, also of a lost device."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ldo_service.datasets import Sequence
from ldo_service.errors import DataError, DeviceError
from ldo_service.gaussians import (
    GaussianMap,
    GaussianOptimizer,
    GaussianOptimizerConfig,
    Rendering,
    TrainingView,
    densify,
)
from ldo_service.gaussians.map_builder import MapBuilder
from ldo_service.gaussians.map_builder_config import MapBuilderConfig
from ldo_service.geometry import Camera, se3
from ldo_service.kernels.gpu.arrays import HostArray
from ldo_service.kernels.gpu.device import Gpu
from tests.gaussians.conftest import FEW, halved, window
from tests.kernels.gpu.scenes import ARRAYS, SCENES, FilledArrays, plane_rendering

CONFIG = GaussianOptimizerConfig()
SIZE = 32


class CountingArrays(FilledArrays):
    """Arrays of a device that counts downloads, and is lost after a number of them."""

    def __init__(self, downloads_left: float = np.inf) -> None:
        self.downloads, self.downloads_left = 0, downloads_left

    def download(self, array: HostArray) -> np.ndarray:
        if self.downloads == self.downloads_left:
            raise RuntimeError("CUDA error: out of memory")
        self.downloads += 1
        return super().download(array)


@pytest.fixture(autouse=True)
def _setting(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Launch few large programs, and compute without warnings."""
    monkeypatch.setattr(plane_rendering, "LANES", 1024)
    with np.errstate(all="ignore"):
        yield


def optimizer_on(arrays: FilledArrays) -> GaussianOptimizer:
    from ldo_service.gaussians.gpu_backend import GpuBackend  # It imports Triton.

    backend = GpuBackend(arrays, CONFIG.adam, CONFIG.loss, CONFIG.limits)
    return GaussianOptimizer(CONFIG, backend=backend)


class Scene:
    """A map of the room with a training view, and a pose beside that of the view."""

    def __init__(self, room: Sequence) -> None:
        frame, T_map_camera = window(halved(room[0]), SIZE), room.truth().T_world_camera[0]
        self.gaussians, self.camera = GaussianMap(), frame.camera
        densify(self.gaussians, frame, T_map_camera, 0, FEW)
        self.views = {0: TrainingView.of(frame, T_map_camera, 0)}
        self.pose = T_map_camera @ se3.exp(np.array([0.02, -0.03, 0.05, 0.02, 0.01, -0.02]))

    def rendered(self, optimizer: GaussianOptimizer, *, contributions: bool = True) -> Rendering:
        return optimizer.render(self.gaussians, self.camera, self.pose, contributions=contributions)


@pytest.fixture
def scene(room: Sequence) -> Scene:
    return Scene(room)


def assert_same_images(got: Rendering, wanted: Rendering) -> None:
    for name in ("color", "weighted_depth_m", "median_depth_m", "opacity"):
        one, other = getattr(got, name), getattr(wanted, name)
        assert one.dtype == other.dtype
        assert one.flags.c_contiguous
        np.testing.assert_array_equal(one, other)


def assert_same_rendering(got: Rendering, wanted: Rendering, rtol: float = 0) -> None:
    assert_same_images(got, wanted)
    one, other = got.contributions, wanted.contributions
    assert one is not None
    assert other is not None
    for name in ("indices", "top"):
        assert getattr(one, name).dtype == getattr(other, name).dtype
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    np.testing.assert_allclose(one.weights, other.weights, rtol=rtol)


def test_rendering_equals_that_of_the_cpu(scene: Scene) -> None:
    on_gpu, on_cpu = optimizer_on(ARRAYS), GaussianOptimizer(CONFIG)
    wanted = scene.rendered(on_cpu)
    assert wanted.opacity.min() < 0.2
    assert np.mean(wanted.median_depth_m > 0) > 0.5
    assert_same_rendering(scene.rendered(on_gpu), wanted, rtol=2e-6)
    plain = scene.rendered(on_gpu, contributions=False)
    assert_same_images(plain, wanted)
    assert plain.contributions is None
    assert on_gpu.device.device == "cuda"


def test_hidden_gaussians_contribute_nothing(scene: Scene) -> None:
    cloud = SCENES["cloud"]
    scene.gaussians, scene.camera, scene.pose = GaussianMap(), cloud.camera, np.eye(4)
    scene.gaussians.add(cloud.rows, 0)
    wanted, got = scene.rendered(GaussianOptimizer(CONFIG)), scene.rendered(optimizer_on(ARRAYS))
    assert_same_rendering(got, wanted, rtol=2e-6)
    assert got.contributions is not None
    assert got.contributions.weights.min() > 0


def test_empty_map_is_rendered(scene: Scene) -> None:
    scene.gaussians = GaussianMap()
    shown = scene.rendered(optimizer_on(ARRAYS))
    assert_same_rendering(shown, scene.rendered(GaussianOptimizer(CONFIG)))
    assert shown.contributions is not None
    assert (shown.contributions.top == -1).all()


def test_lens_distortion_is_no_failure_of_the_device(scene: Scene) -> None:
    optimizer = optimizer_on(ARRAYS)
    scene.camera = Camera(8, 8, 8.0, 8.0, 4.0, 4.0, (0.1, 0.0, 0.0, 0.0))
    with pytest.raises(DataError, match="rectified"):
        scene.rendered(optimizer)
    assert optimizer.device.device == "cuda"


class NanArrays(FilledArrays):
    """Arrays of a device that downloads NaN in the first value of images with some dimensions."""

    def __init__(self, dimensions: int) -> None:
        self.dimensions = dimensions

    def download(self, array: HostArray) -> np.ndarray:
        values = super().download(array)
        if values.ndim == self.dimensions and values.dtype == np.float32:
            values.flat[0] = np.nan
        return values


@pytest.mark.parametrize("dimensions", [3, 2])
def test_cpu_repeats_a_rendering_with_nan(scene: Scene, dimensions: int) -> None:
    """The image planes have three dimensions, and the median depth has two."""
    optimizer = optimizer_on(NanArrays(dimensions))
    assert_same_rendering(scene.rendered(optimizer), scene.rendered(GaussianOptimizer(CONFIG)))
    assert optimizer.device.metrics() == {"device_failed": 1, "on_gpu": 0}


def test_rendering_leaves_the_moments_as_they_are(scene: Scene) -> None:
    """Gaussians that are away during a rendering keep their moments."""
    gaussians, optimizer = scene.gaussians, optimizer_on(ARRAYS)
    rng, n = np.random.default_rng(0), len(gaussians)
    state = {"ids": gaussians.ids.copy(), "steps": rng.integers(1, 9, n).astype(np.int32)}
    state |= {k: rng.uniform(0, 1, (n, 16)).astype(np.float32) for k in ("mean", "square")}
    optimizer.restore(optimizer.snapshot() | state)
    scene.rendered(optimizer)
    away = gaussians.extract(gaussians.ids % 3 == 0)
    scene.rendered(optimizer)
    gaussians.reinsert(*away)
    np.testing.assert_array_equal(optimizer.steps(gaussians), state["steps"])
    for name, values in state.items():
        np.testing.assert_array_equal(optimizer.snapshot()[name], values)


@pytest.mark.parametrize("downloads", range(5))
def test_rendering_of_a_lost_device_is_repeated_by_the_cpu(
    scene: Scene, downloads: int, caplog: pytest.LogCaptureFixture
) -> None:
    """The device fails after each number of downloads that a rendering with contributions has."""
    lost, on_cpu = optimizer_on(CountingArrays(downloads)), GaussianOptimizer(CONFIG)
    lost_map = GaussianMap.restore(scene.gaussians.snapshot())
    assert_same_rendering(scene.rendered(lost), scene.rendered(on_cpu))
    assert lost.device.metrics() == {"device_failed": 1, "on_gpu": 0}
    (record,) = caplog.records
    assert "rendering of a view failed with RuntimeError: CUDA error" in record.getMessage()
    assert "The CPU fits and renders the map from now on" in record.getMessage()
    assert_same_rendering(scene.rendered(lost), scene.rendered(on_cpu))
    lost.optimize(lost_map, dict(scene.views), [0, 0])
    on_cpu.optimize(scene.gaussians, dict(scene.views), [0, 0])
    np.testing.assert_array_equal(lost_map.rows, scene.gaussians.rows)


def builder_on(device: str, room: Sequence, folder: Path) -> MapBuilder:
    """Return a builder with two keyframes, which no iteration has changed."""
    config = MapBuilderConfig(insertion=replace(FEW, coarsest_px=16))
    config = replace(config, optimizer=replace(config.optimizer, device=device))
    builder = MapBuilder(config, folder=folder)
    for keyframe in (0, 4):
        frame = window(halved(room[keyframe]), SIZE)
        builder.add(frame, room.truth().T_world_camera[keyframe], keyframe, 0)
    return builder


@pytest.fixture
def with_gpu(monkeypatch: pytest.MonkeyPatch) -> Callable[[CountingArrays], CountingArrays]:
    """Return a function that makes given arrays the GPU of this machine."""

    def use(arrays: CountingArrays) -> CountingArrays:
        gpu = Gpu("interpreter", {"triton": "3.7.1"}, arrays)
        monkeypatch.setattr("ldo_service.kernels.gpu.device.find_gpu", lambda: gpu)
        return arrays

    monkeypatch.setattr("ldo_service.gaussians.gpu_self_test.run_self_test", lambda _: None)
    return use


def test_builder_renders_views_and_contributions_on_the_gpu(
    room: Sequence, tmp_path: Path, with_gpu: Callable
) -> None:
    arrays = with_gpu(CountingArrays())
    builder = builder_on("cuda", room, tmp_path / "gpu")
    on_cpu = builder_on("cpu", room, tmp_path / "cpu")
    np.testing.assert_array_equal(builder.gaussians.rows, on_cpu.gaussians.rows)
    before = arrays.downloads
    view = builder.render_keyframe(4)
    assert_same_images(view, on_cpu.render_keyframe(4))
    assert arrays.downloads == before + 2  # Image planes and median depth.
    found, wanted = builder.visible_contributions(4), on_cpu.visible_contributions(4)
    assert arrays.downloads == before + 7
    np.testing.assert_array_equal(found.top, wanted.top)
    np.testing.assert_array_equal(found.indices, wanted.indices)
    np.testing.assert_allclose(found.weights, wanted.weights, rtol=2e-6)
    assert builder.metrics()["on_gpu"] == 1


def test_keyframe_is_added_although_its_first_rendering_fails(
    room: Sequence, tmp_path: Path, with_gpu: Callable, caplog: pytest.LogCaptureFixture
) -> None:
    # The first keyframe needs two downloads for its rendering, and one for its empty plan.
    with_gpu(CountingArrays(3))
    builder = builder_on("cuda", room, tmp_path / "gpu")
    on_cpu = builder_on("cpu", room, tmp_path / "cpu")
    assert builder.metrics()["device_failed"] == 1
    assert "rendering of a view failed" in caplog.text
    np.testing.assert_array_equal(builder.gaussians.rows, on_cpu.gaussians.rows)
    assert list(builder.views.store.keyframes()) == [0, 4]


# --- self-test ------------------------------------------------------------------------------------
def view_outcomes() -> tuple:
    from ldo_service.gaussians import gpu_self_test as test  # It imports Triton.

    def outcome(backend_type: type, *arguments: object):
        backend = backend_type(*arguments, test.ADAM, test.WEIGHTS, test.LIMITS)
        return test.render_view(backend, *test._scene())

    wanted = outcome(test.CpuBackend)
    return outcome(test.GpuBackend, ARRAYS), wanted, test.require_equal_view


@pytest.mark.slow
def test_rendering_passes_the_self_test() -> None:
    got, wanted, require_equal_view = view_outcomes()
    require_equal_view(got, wanted)
    assert len(np.unique(wanted.values["top"])) > 20
    assert len(np.unique(wanted.values["median depth"])) > 20


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("HALF", 0.49, "of the pixels have another median depth or top Gaussian"),
        ("over_pixels", lambda x: x.sum(0).sum(0) * 1.00001, "weights differs by a relative"),
    ],
)
def test_wrong_rendering_fails_the_self_test(
    name: str, value: object, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    from ldo_service.kernels.gpu import contributions

    monkeypatch.setattr(contributions, name, value)
    got, wanted, require_equal_view = view_outcomes()
    with pytest.raises(DeviceError, match=message):
        require_equal_view(got, wanted)
