import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ldo_service.errors import DataError
from ldo_service.gaussians import GaussianMap, render
from ldo_service.geometry import Camera, se3

from .conftest import labels_of

CAMERA = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)


def rows_of(n: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    rows = np.zeros((n, 16), np.float32)
    rows[:, 0:3] = np.array([0, 0, 2.5]) + rng.uniform(-1, 1, (n, 3))
    rows[:, 3:6] = rng.uniform(-4, -2, (n, 3))
    rows[:, 6:10] = rng.normal(size=(n, 4))
    rows[:, 6:10] /= np.linalg.norm(rows[:, 6:10], axis=1, keepdims=True)
    rows[:, 10] = rng.uniform(-1, 4, n)
    rows[:, 11:14] = rng.uniform(0, 1, (n, 3))
    return rows


def map_of(*counts: int) -> GaussianMap:
    """Return a map with these numbers of labelled Gaussians at keyframes 0, 1, ..."""
    out = GaussianMap(capacity=2)
    for keyframe, n in enumerate(counts):
        out.add(rows_of(n, keyframe), keyframe)
        out.labels[len(out) - n :] = labels_of(n, keyframe)
    return out


def test_added_rows_are_bitwise_equal_after_growth() -> None:
    gaussians = GaussianMap(capacity=1)
    expected_rows = [rows_of(n, n) for n in (1, 5, 0, 300)]
    ids = [gaussians.add(rows, keyframe) for keyframe, rows in enumerate(expected_rows)]
    assert gaussians.rows.tobytes() == np.concatenate(expected_rows).tobytes()
    np.testing.assert_array_equal(np.concatenate(ids), np.arange(306))
    np.testing.assert_array_equal(gaussians.ids, np.arange(306))
    np.testing.assert_array_equal(gaussians.anchors, np.repeat([0, 1, 3], [1, 5, 300]))


def test_removal_keeps_order_and_ids_are_not_reused() -> None:
    gaussians = map_of(4, 4)
    before = gaussians.rows.copy()
    is_dropped = np.array([1, 0, 0, 1, 0, 0, 0, 1], bool)
    assert gaussians.remove(is_dropped) == 3
    np.testing.assert_array_equal(gaussians.ids, [1, 2, 4, 5, 6])
    np.testing.assert_array_equal(gaussians.rows, before[~is_dropped])
    np.testing.assert_array_equal(gaussians.anchors, [0, 0, 1, 1, 1])
    labels = np.concatenate([labels_of(4, 0), labels_of(4, 1)])[~is_dropped]
    np.testing.assert_array_equal(gaussians.labels, labels)
    np.testing.assert_array_equal(gaussians.add(rows_of(2), 7), [8, 9])
    assert not gaussians.labels[5:].any(), "new Gaussians have no labels"


def test_reinserted_gaussians_are_bitwise_equal() -> None:
    gaussians, untouched = map_of(4, 5, 6), map_of(4, 5, 6)
    extracted = gaussians.extract(gaussians.anchors == 1)
    np.testing.assert_array_equal(extracted.ids, np.arange(4, 9))
    np.testing.assert_array_equal(extracted.anchors, 1)
    assert extracted.rows.tobytes() == rows_of(5, 1).tobytes()
    assert extracted.labels.tobytes() == labels_of(5, 1).tobytes()
    np.testing.assert_array_equal(gaussians.ids, [*range(4), *range(9, 15)])
    gaussians.reinsert(*extracted)
    for name in ("rows", "ids", "anchors", "labels"):
        assert getattr(gaussians, name).tobytes() == getattr(untouched, name).tobytes()


def test_extracted_gaussians_are_copies() -> None:
    gaussians = map_of(3, 3)
    extracted = gaussians.extract(np.ones(6, bool))
    gaussians.add(rows_of(6, 9), 2)
    assert extracted.rows.tobytes() == np.concatenate([rows_of(3, 0), rows_of(3, 1)]).tobytes()


@given(masks=st.lists(st.integers(1, 2**12 - 1), min_size=1, max_size=4), data=st.data())
@settings(deadline=None)
def test_any_order_of_extraction_and_reinsertion_restores_the_map(masks, data) -> None:
    gaussians, untouched = map_of(5, 7), map_of(5, 7)
    extracted = []
    for bits in masks:
        mask = (bits >> gaussians.ids) & 1 == 1
        extracted.append(gaussians.extract(mask))
        assert np.all(np.diff(gaussians.ids) > 0)
    for gaussian_map in (gaussians, untouched):
        gaussian_map.add(rows_of(2, 9), 2)
    for k in data.draw(st.permutations(range(len(extracted)))):
        shuffled = data.draw(st.permutations(range(len(extracted[k][0]))))
        gaussians.reinsert(*(part[list(shuffled)] for part in extracted[k]))
    for name in ("rows", "ids", "anchors", "labels"):
        assert getattr(gaussians, name).tobytes() == getattr(untouched, name).tobytes()


def test_invalid_reinsertion_raises_and_changes_nothing() -> None:
    gaussians = map_of(6)
    ids, rows, anchors, labels = gaussians.extract(np.array([0, 1, 1, 0, 0, 0], bool))
    before = gaussians.snapshot()
    for wrong_ids, reason in (
        ([1, 3], "id 3 is in"),
        ([1, 6], "this map, 0 to 5"),
        ([2, 2], "twice"),
    ):
        with pytest.raises(ValueError, match=reason):
            gaussians.reinsert(np.array(wrong_ids), rows, anchors)
    with pytest.raises(ValueError, match="NaN"):
        gaussians.reinsert(ids, np.full_like(rows, np.nan), anchors)
    with pytest.raises(ValueError, match="shape"):
        gaussians.reinsert(ids, rows[:1], anchors)
    with pytest.raises(ValueError, match="labels"):
        gaussians.reinsert(ids, rows, anchors, labels[:, :5])
    after = gaussians.snapshot()
    assert all(before[name].tobytes() == after[name].tobytes() for name in before)


def test_each_row_fills_one_cache_line() -> None:
    gaussians = map_of(3, 500)
    assert gaussians.rows.ctypes.data % 64 == 0
    assert gaussians.rows.strides == (64, 4)


def test_columns_are_views_of_the_rows() -> None:
    gaussians = map_of(5)
    for column in ("means", "log_scales", "quats", "opacity_logits", "colors"):
        getattr(gaussians, column)[...] = 0.25
        assert np.shares_memory(getattr(gaussians, column), gaussians.rows)
    np.testing.assert_array_equal(gaussians.rows[:, :14], 0.25)


def test_version_increases_with_every_change() -> None:
    gaussians = GaussianMap()
    versions = [gaussians.version]
    gaussians.add(rows_of(3), 0)
    versions.append(gaussians.version)
    gaussians.remove(np.array([True, False, False]))
    versions.append(gaussians.version)
    extracted = gaussians.extract(np.array([True, False]))
    versions.append(gaussians.version)
    gaussians.reinsert(*extracted)
    versions.append(gaussians.version)
    gaussians.move_anchors({0: se3.exp(np.full(6, 0.1))})
    versions.append(gaussians.version)
    gaussians.touch()
    versions.append(gaussians.version)
    assert versions == sorted(set(versions))


def test_correction_moves_only_gaussians_of_its_keyframe() -> None:
    gaussians = map_of(10, 20, 30)
    before = gaussians.rows.copy()
    gaussians.move_anchors({1: se3.exp(np.array([0.1, 0.2, 0.3, 1, 2, 3])), 99: np.eye(4)})
    moved = np.any(gaussians.rows != before, axis=1)
    np.testing.assert_array_equal(moved, gaussians.anchors == 1)
    np.testing.assert_array_equal(gaussians.log_scales, before[:, 3:6])


def test_moved_gaussian_has_transformed_mean_and_rotation() -> None:
    gaussians = map_of(7)
    before = gaussians.rows.astype(float)
    T = se3.exp(np.array([0.4, -1.1, 0.7, 0.5, -0.6, 0.2]))
    gaussians.move_anchors({0: T})
    np.testing.assert_allclose(gaussians.means, se3.transform(T, before[:, :3]), atol=1e-6)
    R_before, R_after = se3.rotation(before[:, 6:10]), se3.rotation(gaussians.quats.astype(float))
    np.testing.assert_allclose(R_after, T[:3, :3] @ R_before, atol=1e-6)


def test_move_and_inverse_move_restore_the_rows() -> None:
    gaussians = map_of(70_000, 500)
    before = gaussians.rows.copy()
    T = {0: se3.exp(np.full(6, 0.3)), 1: se3.exp(np.array([1, -2, 0.5, -1, 0.4, 0.2]))}
    gaussians.move_anchors(T)
    assert np.abs(gaussians.rows - before).max() > 0.1
    gaussians.move_anchors({k: se3.inverse(one) for k, one in T.items()})
    np.testing.assert_allclose(gaussians.rows, before, atol=1e-6)


def test_moved_camera_renders_moved_map_unchanged() -> None:
    gaussians = map_of(300)
    T_map_camera = se3.exp(np.array([0.05, -0.1, 0.02, 0.1, 0.0, -0.2]))
    before = render(gaussians.rows, CAMERA, se3.inverse(T_map_camera))
    T_new_old = se3.exp(np.array([0.5, 0.8, -0.3, 1, -0.5, 0.7]))
    gaussians.move_anchors({0: T_new_old})
    after = render(gaussians.rows, CAMERA, se3.inverse(T_new_old @ T_map_camera))
    assert before.opacity.mean() > 0.2
    np.testing.assert_allclose(after.color, before.color, atol=2e-4)
    np.testing.assert_allclose(after.weighted_depth_m, before.weighted_depth_m, atol=5e-4)


def test_restored_map_continues_bitwise_equal() -> None:
    gaussians = map_of(30, 40)
    gaussians.remove(np.arange(70) % 3 == 0)
    copy = GaussianMap.restore(gaussians.snapshot())
    for one in (gaussians, copy):
        one.add(rows_of(9, 5), 2)
        one.move_anchors({1: se3.exp(np.full(6, 0.1))})
    a, b = gaussians.snapshot(), copy.snapshot()
    assert a.keys() == b.keys()
    assert all(a[name].tobytes() == b[name].tobytes() for name in a)


def test_snapshot_is_independent_of_later_changes() -> None:
    gaussians = map_of(5)
    state = gaussians.snapshot()
    gaussians.means[...] = 0
    gaussians.labels[...] = 0
    assert np.abs(state["rows"][:, :3]).min() > 0
    assert state["labels"].tobytes() == labels_of(5).tobytes()


def test_state_without_labels_raises_with_its_origin() -> None:
    state = map_of(5).snapshot()
    del state["labels"]
    with pytest.raises(DataError, match="an earlier version saved it"):
        GaussianMap.restore(state)


def test_invalid_arguments_raise_and_change_nothing() -> None:
    gaussians = map_of(5)
    before = gaussians.snapshot()
    with pytest.raises(ValueError, match="shape"):
        gaussians.add(np.zeros((2, 14), np.float32), 0)
    with pytest.raises(ValueError, match="NaN"):
        gaussians.add(np.full((2, 16), np.nan, np.float32), 0)
    with pytest.raises(ValueError, match="mask"):
        gaussians.remove(np.zeros(4, bool))
    with pytest.raises(ValueError, match="finite"):
        gaussians.move_anchors({0: np.full((4, 4), np.inf)})
    after = gaussians.snapshot()
    assert all(before[name].tobytes() == after[name].tobytes() for name in before)
