"""Transfers between host and device: their number and size per keyframe, iteration and step."""

import numpy as np
import pytest

from ldo_service.evaluation.iteration import bench_camera, noise_frame, walls
from ldo_service.gaussians import Exposure, GaussianMap, TrainingView
from ldo_service.kernels.gpu.arrays import HostArray
from ldo_service.tracking.alignment import ResidualConfig
from tests.kernels.gpu.scenes import FilledArrays, device_iteration, equation_sums, frame_loss

SIDE_PX = 16
ROW_BYTES = 64
Transfers = tuple[list[int], list[int]]  # Bytes of each upload, and of each download.


class CountingArrays(FilledArrays):
    """Arrays that record the size of each transfer."""

    def __init__(self) -> None:
        self.uploads: list[int] = []
        self.downloads: list[int] = []

    def upload(self, values: np.ndarray) -> HostArray:
        self.uploads.append(np.asarray(values).nbytes)
        return super().upload(values)

    def download(self, array: HostArray) -> np.ndarray:
        values = super().download(array)
        self.downloads.append(values.nbytes)
        return values

    def taken(self) -> Transfers:
        """Return the transfers since the last call."""
        found = self.uploads, self.downloads
        self.uploads, self.downloads = [], []
        return found


def test_keyframe_and_iteration_transfer_only_what_changed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(frame_loss, "PIXEL_LANES", 1024)
    camera = bench_camera(SIDE_PX, SIDE_PX)
    color, depth_m = noise_frame(camera)
    view = TrainingView(0, camera, color, depth_m, np.eye(4))
    gaussians, n = GaussianMap(12), 12
    gaussians.add(walls(n, camera), 0)
    arrays = CountingArrays()
    weights, limits = device_iteration.WEIGHTS, device_iteration.LIMITS
    backend = device_iteration.GpuBackend(arrays, device_iteration.ADAM, weights, limits)

    def iteration() -> tuple[Transfers, int]:
        backend.render(view, is_half=False)
        backend.estimate_exposure()
        _, visible = backend.descend(Exposure(), rate=lambda _: 1.0)
        return arrays.taken(), len(visible.indices)

    backend.begin(gaussians)
    arrays.taken()
    (uploads, downloads), v = iteration()
    images = [SIDE_PX**2 * size for size in (3, 4, 1)]  # Color, depth and mask: once per view.
    assert uploads[:3] == images
    (uploads, downloads), v = iteration()
    assert 0 < v <= n
    assert len(uploads) == 3  # Pose and intrinsics, exposure, learning rates.
    assert sum(uploads) <= 200
    assert len(downloads) == 8  # Block means, four sums of the loss, pose, indices, weights.
    assert downloads[-2:] == [4 * v, 4 * v]
    backend.end()
    uploads, downloads = arrays.taken()
    touched = backend.mirror.downloaded
    assert 0 < touched <= n
    assert uploads == [4 * touched]  # Indices of the touched rows.
    assert downloads == [4 * n, *[touched * ROW_BYTES] * 3]  # Step counts, then rows and moments.
    backend.begin(gaussians)
    backend.end()
    assert arrays.taken() == ([], [4 * n])  # The map is as it was after the last plan.
    gaussians.rows[[3, 7, 9], 0] += 1
    backend.begin(gaussians)
    assert arrays.taken() == ([4 * 3, ROW_BYTES * 3], [])  # Indices, then rows.


def test_step_of_an_alignment_transfers_its_parameters_and_sums(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(equation_sums, "POINT_LANES", 512)
    arrays, scenes = CountingArrays(), device_iteration.alignment_self_test
    equations = device_iteration.GpuEquations(arrays)
    reference, frame = scenes.make_scene(24, 18)
    points, target = reference.points[0], frame.levels[0]
    known = points, target, np.eye(4), scenes.APPEARANCE, ResidualConfig()
    equations.normal_equations(*known)
    assert arrays.taken() == ([points.nbytes, target.texels.nbytes, 100], [408])
    equations.normal_equations(*known)
    assert arrays.taken() == ([100], [408])  # Parameters, and 51 sums in float64.
