"""The synthetic room: depth against closed forms, and views against each other."""

import hashlib

import cv2
import numpy as np
import pytest

from ldo_service.errors import ConfigError
from ldo_service.geometry import RgbdFrame, se3
from ldo_service.synthetic import SyntheticConfig, SyntheticSequence
from ldo_service.synthetic.person import person_at
from ldo_service.synthetic.solids import Solid, interval, vector
from ldo_service.synthetic.textures import TILE_TEXELS, mipmapped


@pytest.fixture(scope="module")
def room() -> SyntheticSequence:
    return SyntheticSequence.named("room")


def bytes_of(sequence: SyntheticSequence, index: int) -> bytes:
    raw = sequence.read(index)
    return raw.color.tobytes() + raw.depth.tobytes()


def warped(source: RgbdFrame, target: RgbdFrame, T_target_source: np.ndarray) -> tuple:
    """Return differences in color and relative depth of source pixels seen in the target."""
    points = se3.transform(T_target_source, source.camera.backproject(source.depth_m))
    u, v = np.moveaxis(source.camera.project(points).astype(np.float32), -1, 0)
    color = cv2.remap(target.color, u, v, cv2.INTER_LINEAR)
    depth_m = cv2.remap(target.depth_m, u, v, cv2.INTER_LINEAR)
    inside = (u > 1) & (v > 1) & (u < source.camera.width - 2) & (v < source.camera.height - 2)
    difference = (depth_m - points[..., 2]) / points[..., 2]
    seen = inside & (np.abs(difference) < 0.02)  # The other pixels are occluded.
    return color[seen].astype(float) - source.color[seen], difference[seen], seen.mean()


def test_the_same_config_gives_the_same_bytes(room: SyntheticSequence) -> None:
    again = SyntheticSequence.named("room")
    assert bytes_of(room, 17) == bytes_of(again, 17)
    np.testing.assert_array_equal(room.truth().T_world_camera, again.truth().T_world_camera)


def test_bytes_are_equal_on_every_machine(room: SyntheticSequence) -> None:
    digest = hashlib.sha256(bytes_of(room, 0) + bytes_of(room, 60)).hexdigest()
    assert digest[:16] == "a1bd5d064a556ebf"


def test_another_seed_changes_the_textures(room: SyntheticSequence) -> None:
    assert bytes_of(room, 0) != bytes_of(SyntheticSequence.named("room", seed=1), 0)


@pytest.mark.parametrize(("i", "j"), [(0, 1), (0, 6), (40, 50), (90, 80), (115, 0)])
def test_views_of_the_same_point_agree(room: SyntheticSequence, i: int, j: int) -> None:
    T = room.truth().T_world_camera
    color, depth, overlap = warped(room[i], room[j], se3.inverse(T[j]) @ T[i])
    assert overlap > 0.5
    assert np.median(np.abs(color)) <= 1.5
    assert np.abs(color).mean() < 3.0
    assert abs(color.mean()) < 0.2
    assert np.median(np.abs(depth)) < 1e-5


def test_pose_error_of_two_centimeters_raises_the_color_difference(room: SyntheticSequence) -> None:
    T = room.truth().T_world_camera
    off = se3.exp(np.array([0, 0, 0, 0.02, 0, 0]))
    good, *_ = warped(room[0], room[6], se3.inverse(T[6]) @ T[0])
    bad, *_ = warped(room[0], room[6], off @ se3.inverse(T[6]) @ T[0])
    assert np.abs(bad).mean() > 1.5 * np.abs(good).mean()


def test_depth_lies_on_the_walls_to_a_micrometer(room: SyntheticSequence) -> None:
    """Every point is inside the room, and many lie on each wall that is seen."""
    T = room.truth().T_world_camera[50]
    p_world = se3.transform(T, room.camera.rays() * room.read(50).depth[..., None])
    half = np.array([2.6, 2.1, 1.3])
    distance = half - np.abs(p_world - [0, 0, 1.3])
    assert distance.min() > -1e-6
    on_wall = np.abs(distance) < 1e-6
    assert (on_wall.any(axis=-1)).mean() > 0.3
    assert (on_wall.any(axis=(0, 1))).all()


def test_the_camera_moves_smoothly_and_comes_back(room: SyntheticSequence) -> None:
    T = room.truth().T_world_camera
    steps = se3.inverse(T[:-1]) @ T[1:]
    angles_deg = np.rad2deg([se3.rotation_angle(step) for step in steps])
    assert angles_deg.max() < 2.5
    assert np.linalg.norm(steps[:, :3, 3], axis=1).max() < 0.03
    assert np.linalg.norm(T[-1, :3, 3] - T[0, :3, 3]) < 0.1
    np.testing.assert_allclose(
        T[:, :3, :3] @ np.swapaxes(T[:, :3, :3], 1, 2), np.tile(np.eye(3), (120, 1, 1)), atol=1e-12
    )
    assert np.linalg.det(T[:, :3, :3]).min() > 0.999


def test_tour_sees_all_directions() -> None:
    tour = SyntheticSequence.named("tour", width_px=16, height_px=12)
    forward = tour.truth().T_world_camera[:, :2, 2]
    headings = np.sort(np.arctan2(forward[:, 1], forward[:, 0]))
    assert np.diff(headings, append=headings[0] + 2 * np.pi).max() < np.deg2rad(5)


def test_kinect_noise_grows_with_the_square_of_depth() -> None:
    exact = SyntheticSequence.named("room", width_px=160, height_px=120)
    noisy = SyntheticSequence.named("room", width_px=160, height_px=120, noise=True)
    z, measured = exact[50].depth_m, noisy[50].depth_m
    assert np.array_equal(noisy[50].depth_m, measured)
    assert not np.array_equal(noisy[51].depth_m, measured)
    assert 0 < (measured == 0).mean() < 0.1
    relative = ((measured - z) / z**2)[measured > 0]
    assert relative.std() == pytest.approx(2.85e-3 * np.sqrt(0.25 + 1 / 12), rel=0.05)
    assert np.array_equal(exact[50].color, noisy[50].color)


def test_every_size_renders() -> None:
    small = SyntheticSequence(SyntheticConfig(frames=1, width_px=33, height_px=17))
    assert small[0].color.shape == (17, 33, 3)


@pytest.mark.parametrize("changes", [{"frames": 0}, {"width_px": 2}, {"path": "spiral"}])
def test_invalid_config_is_rejected(changes: dict) -> None:
    with pytest.raises(ConfigError):
        SyntheticConfig(**changes)


@pytest.mark.parametrize("shape", ["box", "ball", "cylinder"])
def test_ray_intervals_begin_at_the_surface(shape: str) -> None:
    """The reference is marching along the ray through the implicit body."""
    rng = np.random.default_rng(0)
    inside = {
        "box": lambda q: np.abs(q).max(axis=0) < 1,
        "ball": lambda q: (q**2).sum(axis=0) < 1,
        "cylinder": lambda q: ((q[:2] ** 2).sum(axis=0) < 1) & (np.abs(q[2]) < 1),
    }[shape]
    o, d = np.array([3.0, -2.0, 1.5]), rng.uniform([-1.5, 0, -1], [-0.3, 1.2, 0], (400, 3)).T
    enter, leave = interval(shape, vector(o), vector(d))
    t = np.linspace(0, 8, 4001)
    marched = inside(o[:, None, None] + d[:, :, None] * t)
    hit = marched.any(axis=1)
    assert 50 < hit.sum() < 350
    assert ((enter < leave) | ~hit).all()
    np.testing.assert_allclose(enter[hit], t[marched[hit].argmax(axis=1)], atol=2e-3)
    grazing = (enter < leave) & ~hit
    assert (leave - enter)[grazing].max(initial=0) < 2e-3


def test_solids_turn_with_their_heading() -> None:
    solid = Solid("box", (1, 2, 0.5), (2, 1, 1), "", heading=(0.6, 0.8))
    tip = (1 + 0.6, 2 + 0.8, 0.5)
    np.testing.assert_allclose(np.ravel(solid.point_to_local(vector(tip))), [1, 0, 0], atol=1e-15)
    (normal, axis) = solid.normal(vector([[1.0], [0.0], [0.0]]))
    np.testing.assert_allclose(np.ravel(normal), [0.6, 0.8, 0])
    assert axis == 0


def test_far_textures_fade_to_their_mean_and_near_ones_interpolate() -> None:
    rng = np.random.default_rng(0)
    tile = rng.random((TILE_TEXELS, TILE_TEXELS, 3))
    texture = mipmapped(tile, 1.0)
    at = np.array([10.5, 20.5]) / TILE_TEXELS
    near = texture.sample(at[:1], at[1:], np.array([1e-6]))
    far = texture.sample(at[:1], at[1:], np.array([1e3]))
    np.testing.assert_allclose(near[0], tile[20, 10])
    np.testing.assert_allclose(far[0], tile.mean(axis=(0, 1)))
    np.testing.assert_allclose(texture.sample(at[:1] + 3, at[1:] - 2, np.array([1e-6])), near)


def test_walk_differs_from_the_empty_room_only_at_the_person() -> None:
    changes = {"width_px": 80, "height_px": 60}
    walk = SyntheticSequence.named("person", **changes)
    empty = SyntheticSequence.named("person", **changes, person=False)
    sizes = []
    for index in (0, 60, 100):
        is_person = walk.person(index)
        with_person, without = walk[index], empty[index]
        np.testing.assert_array_equal(with_person.depth_m < without.depth_m, is_person)
        np.testing.assert_array_equal(with_person.depth_m[~is_person], without.depth_m[~is_person])
        beside = cv2.dilate(is_person.astype(np.uint8), np.ones((3, 3))) > 0
        np.testing.assert_array_equal(with_person.color[~beside], without.color[~beside])
        sizes.append(is_person.mean())
    assert sizes[0] == 0
    assert min(sizes[1:]) > 0.05


def test_person_stands_on_the_floor_and_alternates_feet() -> None:
    lowest, leads = [], []
    for time_s in np.arange(0, 4, 0.1):
        solids = person_at(time_s)
        lowest.append(min(solid.corners_m()[:, 2].min() for solid in solids))
        left, right = (s.center_m[0] for s in solids if s.texture == "shoes")
        leads.append(left > right)
    np.testing.assert_allclose(lowest, 0, atol=1e-9)
    assert 4 <= np.count_nonzero(np.diff(leads)) <= 7  # Steps of 0.7 m at 1 m/s.
