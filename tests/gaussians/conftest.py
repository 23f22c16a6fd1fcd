"""Gaussians of every kind, to be written and read back."""

import numpy as np
import pytest


@pytest.fixture
def some_rows() -> np.ndarray:
    """Rows [200, 16] with every attribute different: also opacities near 0 and 1, black, white."""
    rng = np.random.default_rng(5)
    rows = np.zeros((200, 16), np.float32)
    rows[:, 0:3] = rng.uniform(-8, 8, (200, 3))
    rows[:, 3:6] = rng.uniform(-6, -1, (200, 3))
    rows[:, 6:10] = rng.normal(size=(200, 4))
    rows[:, 10] = rng.uniform(-5, 6, 200)
    rows[:, 11:14] = rng.uniform(0, 1, (200, 3))
    rows[0, 11:14], rows[1, 11:14] = 0, 1
    return rows
