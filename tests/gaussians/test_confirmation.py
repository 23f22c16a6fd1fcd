"""Tests of `ldo_service.gaussians.confirmation`."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from ldo_service.gaussians.confirmation import Confirmation, VisibilityCheck
from ldo_service.gaussians.map_builder import MapBuilder
from ldo_service.gaussians.map_builder_config import MapBuilderConfig
from ldo_service.gaussians.model import GaussianMap
from ldo_service.gaussians.pruning import PruningConfig
from ldo_service.gaussians.renderer import VisibleGaussians

from .conftest import Posed

CONFIG = PruningConfig(confirm_keyframes=2, min_weight_px=0.25)


@pytest.fixture
def posed_keyframes(small_room: Callable[[int], Posed]) -> MapBuilder:
    builder = MapBuilder()
    for keyframe in (0, 1, 2):
        builder.add(*small_room(keyframe), keyframe, 0)
    return builder


def visible(weights: dict[int, float]) -> VisibleGaussians:
    return VisibleGaussians(
        np.array(list(weights), np.uint32),
        np.array(list(weights.values()), np.float32),
        np.zeros(6),
    )


def test_gaussian_is_hidden_only_if_all_iterations_show_too_little_of_it() -> None:
    check = VisibilityCheck(9, [1, 2], 5, 0.25)
    check.observe(1, visible({0: 0.1, 1: 0.3, 2: 0.1, 3: 0.1}))
    check.observe(1, visible({1: 0.1}))
    check.observe(9, visible({2: 0.3}))
    check.observe(5, visible({0: 9.0}))  # This keyframe is not part of the check.
    assert check.hidden_mask(np.array([1, 1, 1, 9, 1])).tolist() == [
        True,
        False,
        False,
        False,
        True,
    ]


def test_gaussian_without_an_iteration_on_its_keyframe_is_not_hidden() -> None:
    check = VisibilityCheck(9, [1, 2], 2, 0.25)
    check.observe(1, visible({0: 0.1}))
    assert not check.hidden_mask(np.array([1, 2])).any()  # Keyframe 9 has no iteration.
    check.observe(9, visible({0: 0.1}))
    assert check.hidden_mask(np.array([1, 2])).tolist() == [True, False]


def test_check_needs_enough_keyframes_and_a_positive_weight(posed_keyframes: MapBuilder) -> None:
    for config, counts in ((CONFIG, [0, 0, 1]), (replace(CONFIG, min_weight_px=0), [0, 0, 0])):
        confirmation = Confirmation(posed_keyframes.views.store, config, seed=0)
        checked = [len(confirmation.start(newest, 0).keyframes) for newest in (0, 1, 2)]
        assert checked == counts


def test_gaussians_behind_a_surface_are_removed(small_room: Callable[[int], Posed]) -> None:
    frame, T_map_camera = small_room(0)
    surface = MapBuilder()
    surface.add(frame, T_map_camera, 0, 0)
    planted = surface.gaussians.rows[:200].copy()
    position = T_map_camera[:3, 3]
    planted[:, :3] = position + 1.3 * (planted[:, :3] - position)  # Farther on the same rays.
    remaining = {}
    for min_weight_px in (0.0, 0.25):
        config = MapBuilderConfig(pruning=replace(CONFIG, min_weight_px=min_weight_px))
        builder = MapBuilder(config)
        builder.add(frame, T_map_camera, 0, 4)
        builder.restore(with_rows(builder.snapshot(), planted))
        for keyframe in (1, 2, 3):
            builder.add(*small_room(keyframe), keyframe, 4)
        remaining[min_weight_px] = len(builder.gaussians)
    assert remaining[0.25] < remaining[0.0] - 150


def with_rows(state: dict, rows: np.ndarray) -> dict:
    """Return the snapshot of a map builder with additional Gaussians of keyframe 0."""
    gaussians = GaussianMap.restore(state["map"])
    gaussians.add(rows, 0)
    return {**state, "map": gaussians.snapshot()}
