"""Training targets of cells, on drawings with a known result."""

import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

COUCH, CUP = 10, 20  # Instance ids in the plane.
NAMES = {COUCH: 3, CUP: 5}


@pytest.fixture
def cells(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "training")
    import cells

    yield cells
    del sys.modules["cells"]


def frame() -> tuple[np.ndarray, np.ndarray]:
    """Return a frame with a couch and a cup: the plane of ids, and the names of ids.

    The couch has 160x96 pixels from (64, 64); the cup on it has 6x6 in the cell of (128, 96).
    """
    plane, names = np.zeros((256, 320), np.uint8), np.full(256, -1)
    plane[64:160, 64:224] = COUCH
    plane[97:103, 129:135] = CUP
    for k, name in NAMES.items():
        names[k] = name
    return plane, names


def targets_by_stride(cells: ModuleType, plane: np.ndarray, names: np.ndarray) -> dict[int, tuple]:
    """Return names, weights, boxes and whether boxes are targets, by rows and columns of a grid."""
    columns = cells.make_targets(plane, cells.visible(plane, names))
    grids, start = {}, 0
    for stride in cells.STRIDES_PX:
        shape = tuple(side // stride for side in plane.shape)
        end = start + shape[0] * shape[1]
        grids[stride] = tuple(c[start:end].reshape(*shape, *c.shape[1:]) for c in columns)
        start = end
    return grids


def test_small_object_has_its_cell_and_the_large_one_the_others(cells: ModuleType) -> None:
    names, _, boxes, _ = targets_by_stride(cells, *frame())[8]
    assert names[12, 16] == NAMES[CUP]
    assert boxes[12, 16].tolist() == [129, 97, 135, 103]
    is_couch = np.zeros(names.shape, bool)
    is_couch[8:20, 8:28] = True
    is_couch[12, 16] = False
    assert (names[is_couch] == NAMES[COUCH]).all()
    assert (boxes[is_couch] == [64, 64, 224, 160]).all()
    is_couch[12, 16] = True
    assert (names[~is_couch] == cells.NOTHING).all()


def test_boxes_are_targets_in_the_grids_of_their_size(cells: ModuleType) -> None:
    grids = targets_by_stride(cells, *frame())
    cells_of_couch = zip(grids, ((14, 10), (7, 5), (3, 3)), strict=True)
    is_target = [bool(grids[stride][3][cell]) for stride, cell in cells_of_couch]
    assert is_target == [False, True, True]  # The root of its area is 124 pixels.
    assert grids[8][3][12, 16]
    assert not grids[8][3][0, 0]


def test_cells_of_an_object_share_its_weight(cells: ModuleType) -> None:
    names, weights, _, _ = targets_by_stride(cells, *frame())[8]
    assert weights[12, 16] == 1
    couch = weights[names == NAMES[COUCH]]
    np.testing.assert_allclose(couch, 1 / np.sqrt(len(couch)), rtol=1e-6)
    np.testing.assert_allclose(weights[names == cells.NOTHING], cells.NOTHING_WEIGHT)


def test_cell_that_is_covered_by_a_third_has_no_weight(cells: ModuleType) -> None:
    plane, names = frame()
    plane[:, 64:69] = 0  # The first column of the couch keeps 3 of 8 pixels.
    _, weights, _, _ = targets_by_stride(cells, plane, names)[8]
    assert (weights[8:20, 8] == 0).all()
    assert (weights[8:20, 9] > 0).all()


def test_frame_without_objects_has_no_boxes(cells: ModuleType) -> None:
    _, names = frame()
    grids = targets_by_stride(cells, np.zeros((256, 320), np.uint8), names)
    for labels, weights, _, has_box in grids.values():
        assert (labels == cells.NOTHING).all()
        assert not has_box.any()
        assert (weights > 0).all()
