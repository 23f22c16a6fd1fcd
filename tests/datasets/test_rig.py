import numpy as np
import pytest

from ldo_service.datasets import SequenceOptions
from ldo_service.datasets.rig import Rig
from ldo_service.errors import ConfigError
from ldo_service.geometry import Camera, se3

A, B = Camera(64, 48, 50, 50, 31, 24), Camera(32, 24, 25, 25, 15, 12)


@pytest.mark.parametrize(
    ("xi", "is_one_view"),
    [([0] * 6, True), ([0, 0, 0, 5e-5, 0, 0], True), ([0, 0, 0, 0, 1e-3, 0], False)],
)
def test_cameras_a_millimeter_apart_are_two_views(xi: list[float], is_one_view: bool) -> None:
    assert Rig(A, B, se3.exp(np.array(xi))).is_one_view is is_one_view


def test_color_camera_pose_follows_from_t_color_depth() -> None:
    """Both cameras give a point the same world coordinates."""
    T_color_depth = se3.exp(np.array([0.1, 0.2, -0.3, 0.02, -0.01, 0.03]))
    T_world_depth = se3.exp(np.array([-0.5, 0.1, 1.0, 3.0, 2.0, 1.0]))
    T_world_color = Rig(A, B, T_color_depth).T_world_color(T_world_depth)
    p_depth = np.array([0.3, -0.4, 2.0])
    np.testing.assert_allclose(
        se3.transform(T_world_color, se3.transform(T_color_depth, p_depth)),
        se3.transform(T_world_depth, p_depth),
        atol=1e-12,
    )


def test_options_replace_what_they_name_and_nothing_else() -> None:
    rig = SequenceOptions(depth_camera=A).over(Rig(B, B))
    assert (rig.color_camera, rig.depth_camera) == (B, A)
    assert np.array_equal(rig.T_color_depth, np.eye(4))
    assert SequenceOptions().is_default
    assert not SequenceOptions(depth_camera=A).is_default


def test_transform_that_is_not_rigid_is_rejected() -> None:
    for T in (2 * np.eye(4), np.eye(3), np.full((4, 4), np.nan)):
        with pytest.raises(ConfigError, match="expected a rigid transform"):
            SequenceOptions(T_color_depth=T)


def test_unknown_stream_of_topics_is_refused() -> None:
    with pytest.raises(ConfigError, match="'infrared'"):
        SequenceOptions(topics={"infrared": "/x"})
