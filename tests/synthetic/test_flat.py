"""The synthetic flat: exact geometry, realistic sensor noise, and its cache of frames."""

import hashlib
import itertools
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from ldo_service.datasets import open_sequence
from ldo_service.errors import ConfigError, DataError
from ldo_service.geometry import RgbdFrame, se3
from ldo_service.storage.cache_folder import cache_root
from ldo_service.synthetic import FlatConfig, FlatSequence
from ldo_service.synthetic.flat import CLASS_NAMES, COCO_COUNT, cache
from ldo_service.synthetic.flat.__main__ import contents, motion
from ldo_service.synthetic.flat.building import CORRIDOR_SIZE_M, HEIGHT_M, panels
from ldo_service.synthetic.flat.sensor import SHUTTER_S, Sensor, blur, is_shadowed
from ldo_service.synthetic.flat.walk import hand_held
from ldo_service.synthetic.solids import TAPERS, Solid, interval, vector

SMALL = {"width_px": 160, "height_px": 120}


@pytest.fixture(scope="module", autouse=True)
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Return the cache folder of this module."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LDO_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield cache_root()


@pytest.fixture(scope="module")
def exact() -> FlatSequence:
    return FlatSequence.named("flat-exact", **SMALL)


@pytest.fixture(scope="module")
def noisy(exact: FlatSequence) -> FlatSequence:
    """Return the same flat with noise; it shares the renderer, as shadows are slow to compute."""
    sequence = FlatSequence.named("flat", **SMALL)
    sequence.__dict__["_renderer"] = exact._renderer
    return sequence


def bytes_of(sequence: FlatSequence, index: int) -> bytes:
    raw, labels = sequence.read(index), sequence.labels(index)
    planes = (raw.color, raw.depth, labels.class_ids, labels.instance_ids)
    return b"".join(plane.tobytes() for plane in planes)


def warped(source: RgbdFrame, target: RgbdFrame, T_target_source: np.ndarray) -> tuple:
    """Return differences in color and relative depth of source pixels seen in the target."""
    points = se3.transform(T_target_source, source.camera.backproject(source.depth_m))
    u, v = np.moveaxis(source.camera.project(points).astype(np.float32), -1, 0)
    color = cv2.remap(target.color, u, v, cv2.INTER_LINEAR)
    depth_m = cv2.remap(target.depth_m, u, v, cv2.INTER_LINEAR)
    inside = (u > 1) & (v > 1) & (u < source.camera.width - 2) & (v < source.camera.height - 2)
    inside &= points[..., 2] > 0.1
    difference = (depth_m - points[..., 2]) / points[..., 2]
    seen = inside & (np.abs(difference) < 0.02)  # The other pixels are occluded.
    return color[seen].astype(float) - source.color[seen], difference[seen], seen.mean()


def world_points(sequence: FlatSequence, index: int) -> np.ndarray:
    T_world_camera = sequence.truth().T_world_camera[index]
    return se3.transform(
        T_world_camera, sequence.camera.rays() * sequence.read(index).depth[..., None].astype(float)
    )


def test_both_flats_open_by_name(folder: Path) -> None:
    flat = open_sequence("synthetic:flat")
    assert (flat.name, flat.camera.width, flat.camera.height) == ("synthetic:flat", 640, 480)
    assert np.diff(flat.stamps_ns).mean() == pytest.approx(1e9 / 15)
    assert open_sequence("synthetic:flat-exact").name == "synthetic:flat-exact"
    assert not folder.exists() or not list(folder.rglob("*.frame"))


def test_unknown_name_lists_the_flats() -> None:
    with pytest.raises(DataError, match=r"castle.*synthetic:room.*synthetic:flat-exact"):
        open_sequence("synthetic:castle")


@pytest.mark.parametrize("changes", [{"width_px": 8}, {"height_px": 0}, {"seed": -1}])
def test_invalid_config_is_rejected(changes: dict) -> None:
    with pytest.raises(ConfigError):
        FlatConfig(**changes)


def test_bytes_are_equal_on_every_machine(exact: FlatSequence, noisy: FlatSequence) -> None:
    frames = [bytes_of(sequence, index) for sequence in (exact, noisy) for index in (0, 330)]
    assert hashlib.sha256(b"".join(frames)).hexdigest()[:16] == "09daa59095c99a14"


def test_the_same_config_gives_the_same_bytes_without_the_cache(
    noisy: FlatSequence, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stored = bytes_of(noisy, 60)
    monkeypatch.setenv("LDO_CACHE", str(tmp_path))
    again = FlatSequence.named("flat", **SMALL)
    assert not again.cache_folder.exists()
    assert bytes_of(again, 60) == stored


def test_another_seed_changes_textures_and_camera_shake(exact: FlatSequence) -> None:
    other = FlatSequence.named("flat-exact", seed=1, **SMALL)
    assert not np.array_equal(other.truth().T_world_camera, exact.truth().T_world_camera)
    ours, theirs = (
        [s.texture for thing in seq.things for s in thing.solids] for seq in (exact, other)
    )
    assert np.mean([a != b for a, b in zip(ours, theirs, strict=True)]) > 0.5


@pytest.mark.parametrize(("i", "j"), [(0, 2), (106, 110), (265, 268), (470, 475), (639, 0)])
def test_views_of_the_same_point_agree(exact: FlatSequence, i: int, j: int) -> None:
    T = exact.truth().T_world_camera
    color, depth, overlap = warped(exact[i], exact[j], se3.inverse(T[j]) @ T[i])
    assert overlap > 0.5
    assert np.median(np.abs(color)) <= 2
    assert abs(color.mean()) < 1.5
    assert np.median(np.abs(depth)) < 5e-5  # Depth is not linear between pixels.


@pytest.mark.parametrize("index", [20, 180])
def test_floor_and_ceiling_are_where_they_were_built(exact: FlatSequence, index: int) -> None:
    z_m, names = world_points(exact, index)[..., 2], exact.labels(index).class_ids
    floor = names == CLASS_NAMES.index("floor")
    assert floor.any()
    np.testing.assert_allclose(z_m[floor], 0, atol=1e-5)
    np.testing.assert_allclose(z_m[names == CLASS_NAMES.index("ceiling")], HEIGHT_M, atol=1e-5)
    assert z_m.min() > -1e-5
    assert z_m.max() < HEIGHT_M + 1e-5


@pytest.mark.parametrize("index", [20, 180, 420])
def test_labelled_points_lie_in_the_box_of_their_object(exact: FlatSequence, index: int) -> None:
    points, labels = world_points(exact, index), exact.labels(index)
    instances = np.unique(labels.instance_ids)
    assert len(instances) > 4
    for instance in instances[instances > 0]:
        thing, mask = exact.things[instance - 1], labels.instance_ids == instance
        center_m, size_m = thing.bounds_m
        assert (np.abs(points[mask] - center_m) <= size_m / 2 + 1e-5).all()
        assert (labels.class_ids[mask] == CLASS_NAMES.index(thing.label)).all()


def test_pixels_belong_either_to_the_building_or_to_an_object(exact: FlatSequence) -> None:
    labels = exact.labels(20)
    building = labels.class_ids >= CLASS_NAMES.index("wall")
    assert np.array_equal(building, labels.instance_ids == 0)
    assert (labels.class_ids.dtype, labels.instance_ids.dtype) == (np.uint8, np.uint16)


def test_depth_steps_coincide_with_label_steps(exact: FlatSequence) -> None:
    depth, ids = exact.read(20).depth, exact.labels(20).instance_ids
    step = np.abs(np.diff(depth, axis=1)) > 0.5
    assert step.sum() > 50
    assert (np.diff(ids.astype(int), axis=1) != 0)[step].mean() > 0.9


def test_labels_are_the_same_with_and_without_noise(
    exact: FlatSequence, noisy: FlatSequence
) -> None:
    for plane in ("class_ids", "instance_ids"):
        a, b = (getattr(sequence.labels(20), plane) for sequence in (exact, noisy))
        np.testing.assert_array_equal(a, b)


def test_depth_noise_has_kinect_statistics(exact: FlatSequence, noisy: FlatSequence) -> None:
    """Disparities are quantized; the statistics are robust because edges are ragged."""
    z, measured = exact.read(180).depth.astype(float), noisy.read(180).depth.astype(float)
    seen = measured > 0
    assert 0.3 < seen.mean() < 0.995
    assert measured[seen].min() >= 0.4
    assert measured[seen].max() <= 5.0
    disparity = 1 / (2.85e-3 * measured[seen])
    np.testing.assert_allclose(disparity, np.round(disparity), atol=1e-3)
    error = ((measured - z) / z**2)[seen]
    spread = np.subtract(*np.percentile(error, [75, 25])) / 1.349
    assert spread == pytest.approx(2.85e-3 * np.sqrt(0.25 + 1 / 12), rel=0.25)
    assert abs(np.median(error)) < 1e-3


def test_neighbors_share_their_depth_noise(exact: FlatSequence, noisy: FlatSequence) -> None:
    z, measured = exact.read(20).depth.astype(float), noisy.read(20).depth.astype(float)
    flat = (measured > 0) & (np.abs(measured - z) < 0.01 * z**2)  # Ragged edges are excluded.
    error = np.where(flat, (measured - z) / z**2, 0)
    variance = (error**2)[flat].mean()

    def correlation(lag_px: int) -> float:
        both = flat[:, lag_px:] & flat[:, :-lag_px]
        return float((error[:, lag_px:] * error[:, :-lag_px])[both].mean() / variance)

    assert 0.2 < correlation(1) < 0.7
    assert abs(correlation(20)) < 0.1


def test_dark_surfaces_and_far_ones_lose_their_depth(
    exact: FlatSequence, noisy: FlatSequence
) -> None:
    lost_dark, lost_bright, dark_count = 0, 0, 0
    for index in (100, 180, 200, 420):
        raw, depth = exact.read(index), noisy.read(index).depth
        brightness, near = raw.color.mean(axis=2) / 255, (raw.depth < 4) & (raw.depth > 0.6)
        dark, bright = near & (brightness < 0.05), near & (brightness > 0.3)
        dark_count += dark.sum()
        lost_dark += (depth == 0)[dark].sum()
        lost_bright += (depth == 0)[bright].mean() / 4
        assert not depth[raw.depth > 5.2].any()
    assert dark_count > 100
    assert lost_dark / dark_count > 0.3
    assert lost_bright < 0.15


@pytest.mark.parametrize(("left", "right", "near_m"), [(40, 50, 1.0), (30, 70, 2.0)])
def test_projector_shadow_is_moved_by_the_parallax(left: int, right: int, near_m: float) -> None:
    """The shadow of a bar has the width of the bar and is moved right by the parallax."""
    depth_m, parallax_px_m = np.full((1, 200), 3.0), 0.075 * 520
    depth_m[:, left:right] = near_m
    shift = parallax_px_m * (1 / near_m - 1 / 3.0)
    behind = np.zeros(200, bool)
    behind[round(left + shift) : round(right + shift)] = True
    behind[left:right] = False
    assert np.sum(is_shadowed(depth_m, parallax_px_m)[0] != behind) <= 1


def test_blur_follows_the_motion_and_keeps_static_pixels() -> None:
    light = np.zeros((9, 40, 3))
    light[:, 20] = 1.0
    still = np.zeros((9, 40))
    np.testing.assert_array_equal(blur(light, still, still), light)
    moved = blur(light, still + 7.0, still)[4, :, 0]
    np.testing.assert_allclose(moved[17:24], 1 / 7)
    assert moved.sum() == pytest.approx(1)
    np.testing.assert_allclose(blur(light, still, still + 5.0), light)


@pytest.mark.parametrize("index", [308, 617])
def test_blur_length_is_the_rotation_while_the_shutter_is_open(
    exact: FlatSequence, index: int
) -> None:
    sensor = Sensor(exact.camera, hand_held(exact.config.seed), 0)
    far_m = np.full((120, 160), 1e6)  # Translation moves no pixels at this depth.
    du_px, dv_px = sensor.motion_px(index, far_m)
    turn_rad_s = np.deg2rad(motion(exact.truth().T_world_camera).turns_deg_s[index])
    middle_px = np.hypot(du_px[60, 80], dv_px[60, 80])
    assert middle_px == pytest.approx(turn_rad_s * SHUTTER_S * exact.camera.fx, rel=0.2)


def test_exposure_drifts(exact: FlatSequence, noisy: FlatSequence) -> None:
    gains = []
    for index in (0, 60, 180, 330):
        sharp, recorded = exact.read(index).color, noisy.read(index).color
        between = (sharp > 40) & (sharp < 190)
        gains.append(np.median(recorded[between] / sharp[between]))
    assert max(gains) / min(gains) > 1.05


def test_the_walk_is_hand_held(exact: FlatSequence) -> None:
    T = exact.truth().T_world_camera
    moved = motion(T)
    low, high = np.percentile(moved.speeds_m_s, [2, 98])
    assert 0.3 <= low < 0.65 < high <= 0.8
    assert 50 < moved.turns_deg_s.max() <= 60
    shake = np.linalg.norm(np.diff(T[:, :3, 3], 3, axis=0), axis=1)
    assert np.median(shake) > 1e-4  # A smooth spline has less than a tenth of it.
    np.testing.assert_allclose(
        T[:, :3, :3] @ np.swapaxes(T[:, :3, :3], 1, 2),
        np.tile(np.eye(3), (len(T), 1, 1)),
        atol=1e-12,
    )


def test_the_walk_passes_each_room_twice_and_returns(exact: FlatSequence) -> None:
    T = exact.truth().T_world_camera
    y_m = T[:, 1, 3]
    rooms = np.where(
        y_m > CORRIDOR_SIZE_M[1] / 2, "A", np.where(y_m < -CORRIDOR_SIZE_M[1] / 2, "B", "")
    )
    visits = [rooms[0], *(b for a, b in itertools.pairwise(rooms) if a != b)]
    assert [visit for visit in visits if visit] in (list("ABAB"), list("ABABA"))
    back = se3.inverse(T[0]) @ T[-1]
    assert np.linalg.norm(back[:3, 3]) < 0.3
    assert np.rad2deg(se3.rotation_angle(back)) < 20


def test_camera_keeps_its_distance_from_all_solids(exact: FlatSequence) -> None:
    """The distance to the box of each solid, in its own frame, is at least 0.2 m."""
    eyes = vector(exact.truth().T_world_camera[:, :3, 3].T)
    solids = [panel.solid for panel in panels()]
    for solid in solids + [solid for thing in exact.things for solid in thing.solids]:
        local = np.abs(np.stack(solid.point_to_local(eyes)))
        reach = 1 + 0.4 / np.array(solid.size_m)[:, None]
        assert not (local < reach).all(axis=0).any(), solid


def test_the_ends_of_the_corridor_look_alike(exact: FlatSequence) -> None:
    T = np.array([[0, 0, 1, 1.4], [-1, 0, 0, 0.1], [0, -1, 0, 1.4], [0, 0, 0, 1.0]])
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    one, other = (exact._renderer.render(exact.raw_camera, pose) for pose in (T, half_turn @ T))
    np.testing.assert_allclose(one.light, other.light, atol=0.02)
    np.testing.assert_array_equal(one.class_ids, other.class_ids)
    things = set(np.unique(one.instance_ids)) & set(np.unique(other.instance_ids))
    assert things == {0}


def test_classes_have_several_shapes_and_textures(exact: FlatSequence) -> None:
    def shape(thing) -> tuple:
        return tuple((solid.shape, solid.size_m) for solid in thing.solids)

    shapes, textures = {}, {}
    for thing in exact.things:
        shapes.setdefault(thing.label, set()).add(shape(thing))
        textures.setdefault(thing.label, set()).add(tuple(s.texture for s in thing.solids))
    assert sum(len(kinds) > 1 for kinds in shapes.values()) >= 12
    assert len(shapes["chair"]) >= 3
    repeated = Counter(thing.label for thing in exact.things)
    assert all(len(textures[name]) > 1 for name, count in repeated.items() if count > 2)


def test_the_flat_holds_objects_inside_and_outside_coco(exact: FlatSequence) -> None:
    labels = [thing.label for thing in exact.things]
    coco = [label for label in labels if label in CLASS_NAMES[:COCO_COUNT]]
    assert len(set(coco)) >= 25
    assert len(set(labels) - set(coco)) >= 15
    assert COCO_COUNT == 80
    assert (CLASS_NAMES.index("chair"), CLASS_NAMES.index("toothbrush")) == (56, 79)


@pytest.mark.slow
def test_walk_shows_enough_objects_and_bare_walls(exact: FlatSequence) -> None:
    shown = contents(exact, stride=6)
    objects = shown.objects_per_class
    coco = sum(n for label, n in objects.items() if label in CLASS_NAMES[:COCO_COUNT])
    assert coco >= 25
    assert sum(objects.values()) - coco >= 15
    assert shown.coco_classes >= 25
    assert shown.wall_share >= 0.4
    assert shown.missing_depth_share == 0


@pytest.mark.parametrize("index", [20, 180])
def test_walls_are_weakly_textured_but_not_flat(exact: FlatSequence, index: int) -> None:
    """The measure is the mean difference from the local gray, away from outlines and shadows."""
    gray = exact.read(index).color.mean(axis=2)
    wall = exact.labels(index).class_ids == CLASS_NAMES.index("wall")
    inner = cv2.erode(wall.astype(np.uint8), np.ones((9, 9))) > 0
    spread = np.abs(gray - cv2.GaussianBlur(gray, (0, 0), 3))[inner]
    assert 0.1 < spread.mean() < 3


@pytest.mark.parametrize("damage", [b"", b"nothing of use", None])
def test_damaged_cached_frame_is_rendered_again(noisy: FlatSequence, damage: bytes | None) -> None:
    before = bytes_of(noisy, 5)
    (file,) = noisy.cache_folder.glob("0005.frame")
    stored = file.read_bytes()
    file.write_bytes(stored[:-100] + bytes(100) if damage is None else damage)
    assert bytes_of(noisy, 5) == before
    assert file.read_bytes() == stored


def test_a_cached_frame_is_not_rendered(noisy: FlatSequence) -> None:
    before = bytes_of(noisy, 6)
    again = FlatSequence.named("flat", **SMALL)
    again.__dict__["_renderer"] = None  # The sequence cannot render.
    assert bytes_of(again, 6) == before
    assert sorted(path.suffix for path in noisy.cache_folder.iterdir())[-1] == ".frame"


def test_sequence_without_a_writable_cache_gives_the_same_bytes(
    noisy: FlatSequence, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setenv("LDO_CACHE", str(tmp_path / "file"))
    without_cache = FlatSequence.named("flat", **SMALL)
    without_cache.__dict__["_renderer"] = noisy._renderer
    assert bytes_of(without_cache, 5) == bytes_of(noisy, 5)


def test_full_cache_drops_the_oldest_sequence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LDO_CACHE", str(tmp_path))
    monkeypatch.setattr(cache, "LIMIT_BYTES", 1500)
    frame = cache.CachedFrame(
        np.zeros((8, 8, 3), np.uint8),
        np.ones((8, 8), np.float32),
        np.zeros((8, 8), np.uint8),
        np.zeros((8, 8), np.uint16),
    )
    names = [f"sequence {i}" for i in range(12)]
    for name in names:
        cache.FrameCache(name, 8, 8).store(0, frame)
    kept = [cache.FrameCache(name, 8, 8).load(0) is not None for name in names]
    assert kept[-1]
    assert not kept[0]
    assert sum(path.stat().st_size for path in tmp_path.rglob("*.frame")) <= 1500


@pytest.mark.parametrize("shape", ["wheel", *TAPERS])
def test_ray_intervals_of_round_shapes_begin_at_the_surface(shape: str) -> None:
    """The reference is marching along the ray through the implicit body."""

    def inside(q: np.ndarray) -> np.ndarray:
        if shape == "wheel":
            return (q[1] ** 2 + q[2] ** 2 < 1) & (np.abs(q[0]) < 1)
        m, k = TAPERS[shape]
        return (q[0] ** 2 + q[1] ** 2 < (m + k * q[2]) ** 2) & (np.abs(q[2]) < 1)

    rng = np.random.default_rng(0)
    for o in (np.array([2.4, -1.6, 0.7]), np.array([0.4, -0.5, 3.2]), np.array([0.3, 0.4, -2.6])):
        d = (rng.uniform(-0.9, 0.9, (300, 3)) - o).T * 0.5
        enter, leave = interval(shape, vector(o), vector(d))
        t = np.linspace(0, 4, 4001)
        marched = inside(o[:, None, None] + d[:, :, None] * t)
        hit = marched.any(axis=1)
        assert hit.sum() > 50
        assert ((enter < leave) | ~hit).all()
        np.testing.assert_allclose(enter[hit], t[marched[hit].argmax(axis=1)], atol=2e-3)
        assert (leave - enter)[(enter < leave) & ~hit].max(initial=0) < 3e-3


@pytest.mark.parametrize("shape", ["wheel", *TAPERS])
def test_normals_face_the_ray_and_are_perpendicular_to_the_surface(shape: str) -> None:
    solid = Solid(shape, (1.0, 2.0, 0.5), (0.6, 0.8, 1.1), "", (0.6, 0.8))
    rng = np.random.default_rng(0)
    o = np.array([3.0, -1.0, 2.0])
    d = (np.array(solid.center_m) + rng.uniform(-0.08, 0.08, (200, 3)) - o).T
    local = solid.point_to_local(vector(o)), solid.direction_to_local(vector(d))
    enter, leave = interval(shape, *local)
    point = o[:, None] + d * enter
    normal = np.stack(solid.surface(vector(point))[0])
    np.testing.assert_allclose(np.linalg.norm(normal, axis=0), 1)
    assert (np.sum(normal * d, axis=0) < 1e-9).all()
    outside, within = (
        interval(shape, solid.point_to_local(vector(point + s * normal)), local[1])
        for s in (1e-4, -1e-4)
    )
    assert not ((outside[0] < 0) & (outside[1] > 0)).any()
    assert ((within[0] < 0) & (within[1] > 0)).mean() > 0.97
    assert (leave > enter).all()
