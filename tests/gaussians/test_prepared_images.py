from dataclasses import replace

import numpy as np

from ldo_service.gaussians.prepared_images import MAX_IMAGES, PreparedImages
from ldo_service.gaussians.training_views import TrainingView
from ldo_service.geometry import Camera

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)


def training_view(keyframe: int, seed: int = 0) -> TrainingView:
    rng = np.random.default_rng(seed)
    color = rng.integers(0, 256, (3, 48, 64)).astype(np.uint8)
    depth_m = rng.uniform(1, 2, (48, 64)).astype(np.float32)
    mask = (rng.uniform(size=(48, 64)) > 0.1).astype(np.uint8)
    return TrainingView(keyframe, CAMERA, color, depth_m, np.eye(4), mask=mask)


def test_view_is_halved_once() -> None:
    images, view = PreparedImages(), training_view(3)
    half = images.get(view, is_half=True)
    assert images.get(view, is_half=False).image is view
    assert images.get(replace(view, T_map_camera=2 * np.eye(4)), is_half=True) is half
    assert half.blocks is half.blocks
    np.testing.assert_array_equal(half.image.color, view.halved().color)


def test_new_arrays_of_a_keyframe_are_prepared_again() -> None:
    images, view, other = PreparedImages(), training_view(3), training_view(3, seed=1)
    images.get(view, is_half=True)
    for name in ("color", "depth_m", "mask"):
        changed = replace(view, **{name: getattr(other, name)})
        expected = changed.halved()
        image = images.get(changed, is_half=True).image
        np.testing.assert_array_equal(getattr(image, name), getattr(expected, name))
    without_mask = replace(view, mask=None)
    assert images.get(without_mask, is_half=True).image.mask is None
    assert images.get(view, is_half=True).image.mask is not None


def test_least_recently_used_images_are_dropped() -> None:
    images, views = PreparedImages(), [training_view(k) for k in range(MAX_IMAGES + 1)]
    first, second = (images.get(view, is_half=True) for view in views[:2])
    for view in views[2:MAX_IMAGES]:
        images.get(view, is_half=True)
    images.get(views[0], is_half=True)
    images.get(views[MAX_IMAGES], is_half=True)
    assert images.get(views[0], is_half=True) is first
    assert images.get(views[1], is_half=True) is not second
