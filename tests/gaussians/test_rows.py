import numpy as np

from ldo_service.gaussians import rows


def test_kept_rows_move_together_in_place() -> None:
    count = 3 * rows._ROWS_AT_ONCE + 7
    array = np.random.default_rng(0).normal(size=(count, 3))
    kept = np.flatnonzero(np.random.default_rng(1).uniform(size=count) > 0.1)
    kept = kept[kept >= 20]
    expected = np.concatenate([array[:20], array[kept], array[20 + len(kept) :]])
    rows.keep_rows(array, 20, kept)
    np.testing.assert_array_equal(array, expected)
