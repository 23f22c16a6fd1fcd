import filecmp
import json
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

import ldo_service
from ldo_service import Camera, Frame, Pose, Run, Slam, Trajectory, load_config
from ldo_service.commands.cli import main
from ldo_service.datasets import Sequence
from ldo_service.errors import ConfigError, DataError, FrameError, StageError
from ldo_service.runs.summary import Usage

COUNT = 12
# Files of a run whose content does not depend on the time that the run took.
FILES = ("config.yaml", "keyframes.json", "loops.json", "map.ply", "trajectory.txt")
QUICK = {"mapper.iterations": 1}  # Settings of tests that do not look at the map.


@pytest.fixture(scope="module")
def frames(room: Sequence) -> list[Frame]:
    return [room[index] for index in range(COUNT)]


def fed(slam: Slam, frames: list[Frame]) -> list[Pose]:
    return [slam.track(frame.color, frame.depth_m, frame.stamp_ns) for frame in frames]


@pytest.fixture(scope="module")
def finished(frames: list[Frame]) -> Slam:
    with Slam(frames[0].camera) as slam:
        fed(slam, frames)
        slam.finish()
    return slam


@pytest.fixture(scope="module")
def saved(finished: Slam, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return finished.save(tmp_path_factory.mktemp("slam") / "run")


def require_equal(first: Trajectory, second: Trajectory) -> None:
    assert first.stamps_s.tobytes() == second.stamps_s.tobytes()
    assert first.T_world_camera.tobytes() == second.T_world_camera.tobytes()


# --- results --------------------------------------------------------------------------------------
def test_folder_has_the_same_bytes_as_that_of_ldo_run(saved: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    main(["run", "synthetic:room", "--out", str(run), "--max-frames", str(COUNT)])
    assert {path.name for path in saved.iterdir()} == {path.name for path in run.iterdir()}
    assert filecmp.cmpfiles(saved, run, FILES, shallow=False)[0] == list(FILES)


def test_poses_are_read_only_and_end_in_the_trajectory(frames: list[Frame]) -> None:
    with Slam(frames[0].camera, settings=QUICK) as slam:
        poses = fed(slam, frames[:6])
        trajectory = slam.trajectory()
    assert [pose.status for pose in poses] == ["OK"] * 6
    assert [pose.stamp_ns for pose in poses] == [frame.stamp_ns for frame in frames[:6]]
    assert poses[0].keyframe is not None
    np.testing.assert_allclose(trajectory.T_world_camera[-1], poses[-1].T_map_camera, atol=1e-9)
    sigmas = np.sqrt(np.diag(poses[-1].covariance))
    assert 1e-6 < sigmas.min() <= sigmas.max() < 0.01
    with pytest.raises(ValueError, match="read-only"):
        poses[0].T_odom_camera[0, 0] = 2


def test_rendering_looks_like_the_frame(finished: Slam, frames: list[Frame]) -> None:
    pose = finished.trajectory().T_world_camera[-1]
    view = finished.map.render(pose)
    assert view.color.shape == (240, 320, 3)
    assert np.abs(view.color - frames[-1].color / 255).mean() < 0.05
    is_covered = view.opacity > 0.9
    assert is_covered.mean() > 0.9
    error_m = np.abs(view.depth_m - frames[-1].depth_m)[is_covered]
    assert np.median(error_m) < 0.01
    assert view.labels is None


def test_render_uses_the_given_camera_and_any_number_of_threads(finished: Slam) -> None:
    camera = Camera(80, 60, 70.0, 70.0, 40.0, 30.0)
    one, two = (finished.map.render(np.eye(4), camera, threads=n) for n in (1, 2))
    assert one.color.shape == (60, 80, 3)
    assert one.color.tobytes() == two.color.tobytes()


def test_arrays_describe_the_gaussians(finished: Slam) -> None:
    arrays = finished.map.arrays()
    count = len(finished.map)
    assert count > 1000
    assert arrays.means_m.shape == arrays.scales_m.shape == arrays.colors.shape == (count, 3)
    assert (arrays.scales_m > 0).all()
    assert ((arrays.opacities > 0) & (arrays.opacities < 1)).all()
    np.testing.assert_allclose(np.linalg.norm(arrays.quaternions, axis=1), 1, atol=1e-5)
    assert arrays.label_probabilities.shape == (count, 0)
    with pytest.raises(ValueError, match="read-only"):
        arrays.means_m[0] = 0


def test_map_does_not_change_with_later_frames(frames: list[Frame]) -> None:
    with Slam(frames[0].camera, settings=QUICK) as slam:
        fed(slam, frames[:6])
        early = slam.map
        before = early.arrays().means_m.copy()
        fed(slam, frames[6:])
        assert len(slam.map) > len(early)
        np.testing.assert_array_equal(early.arrays().means_m, before)


def test_objects_and_labels_of_a_run_with_a_detector(room: Sequence, tmp_path: Path) -> None:
    with Slam(room.camera, settings={"detector.model": "demo", **QUICK}) as slam:
        for index in range(30):
            frame = room[index]
            slam.track(frame.color, frame.depth_m, frame.stamp_ns)
        slam.finish()
    objects, last = slam.objects(), slam.trajectory().T_world_camera[-1][:3, 3]
    assert objects
    name = objects[0].name
    assert name in [found.name for found in slam.objects(name)]
    assert slam.objects("xylophone") == []
    view = slam.map.render(slam.trajectory().T_world_camera[-1], labels=True)
    assert view.labels is not None
    shown = {slam.map.label_names[label] for label in np.unique(view.labels)}
    assert shown & {found.name for found in objects}
    probabilities = slam.map.arrays().label_probabilities
    assert probabilities.shape[1] == len(slam.map.label_names)
    np.testing.assert_allclose(probabilities.sum(axis=1), 1, atol=1e-5)
    run = Run.open(slam.save(tmp_path / "run"))
    assert [(one.id, one.name) for one in run.objects()] == [(one.id, one.name) for one in objects]
    for one, other in zip(run.objects(), objects, strict=True):
        np.testing.assert_allclose(one.T_map_object, other.T_map_object, atol=1e-6)
        np.testing.assert_array_equal(one.center_m, one.T_map_object[:3, 3])
        assert one.distance_m == pytest.approx(np.linalg.norm(one.center_m - last), abs=1e-4)


# --- arguments ------------------------------------------------------------------------------------
class Exported:
    """An array of another library that supports only DLPack."""

    def __init__(self, array: np.ndarray) -> None:
        self._array = array

    def __dlpack__(self, **options: object) -> object:
        return self._array.__dlpack__(**options)

    def __dlpack_device__(self) -> tuple[int, int]:
        return self._array.__dlpack_device__()


def test_dlpack_buffers_and_integer_depth_give_the_same_poses(frames: list[Frame]) -> None:
    camera = frames[0].camera
    rounded = [np.round(1000 * frame.depth_m).astype(np.uint16) for frame in frames[:4]]
    with Slam(camera, settings=QUICK) as slam:
        expected = [
            slam.track(frame.color, (depth / np.float32(1000)).astype(np.float32), frame.stamp_ns)
            for frame, depth in zip(frames, rounded, strict=False)
        ]
    for wrap in (Exported, memoryview):
        with Slam(camera, depth_scale=1000, settings=QUICK) as slam:
            for pose, frame, depth in zip(expected, frames, rounded, strict=False):
                same = slam.track(wrap(frame.color), wrap(depth), np.int64(frame.stamp_ns))
                np.testing.assert_allclose(same.T_odom_camera, pose.T_odom_camera, atol=1e-6)


def test_buffers_may_be_reused_at_once(frames: list[Frame], finished: Slam) -> None:
    color, depth_m = np.empty_like(frames[0].color), np.empty_like(frames[0].depth_m)
    with Slam(frames[0].camera) as slam:
        for frame in frames:
            color[:], depth_m[:] = frame.color, frame.depth_m
            slam.track(color, depth_m, frame.stamp_ns)
            color[:], depth_m[:] = 77, 0.3
        slam.finish()
    require_equal(slam.trajectory(), finished.trajectory())
    assert slam.map.arrays().means_m.tobytes() == finished.map.arrays().means_m.tobytes()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"color": [[0]]}, "color is a list"),
        ({"depth": None}, "depth is a NoneType"),
        ({"color": np.zeros((240, 320), np.uint8)}, "uint8[H, W, 3]"),
        ({"color": np.zeros((240, 320, 3))}, "color is float64"),
        ({"depth": np.zeros((120, 160), np.float32)}, "Register the depth"),
        ({"depth": np.zeros((240, 320), np.uint16)}, "depth_scale=1000"),
        ({"depth": np.zeros((240, 320), np.int32)}, "depth is int32"),
        ({"stamp_ns": 1.5}, "stamp_ns=1.5 must be an integer"),
        ({"stamp_ns": 0}, "later than the stamp of the last frame"),
        ({"stamp_ns": -1}, "from 0 to"),
        ({"stamp_ns": 2**70}, "from 0 to"),
    ],
)
def test_wrong_frame_names_the_argument_and_tracking_continues(
    frames: list[Frame], change: dict, message: str
) -> None:
    with Slam(frames[0].camera, settings=QUICK) as slam:
        fed(slam, frames[:1])
        good = {"color": frames[1].color, "depth": frames[1].depth_m, "stamp_ns": 10**9}
        with pytest.raises(FrameError) as caught:
            slam.track(**{**good, **change})
        assert message in str(caught.value)
        assert slam.track(**good).status == "OK"


def test_prior_finds_a_fast_camera_at_once_after_it_was_covered(
    room: Sequence, frames: list[Frame]
) -> None:
    """The camera moves three times as fast, so alignment needs the motion of the other odometry."""
    truth = room.truth()
    assert truth is not None
    T_other = np.linalg.inv(truth.T_world_camera[5]) @ truth.T_world_camera  # Any other origin.
    mount = {"tracker.T_base_camera.translation_m": [0.1, 0.2, 0.3]}
    covered = range(4, 9)
    with Slam(room.camera, settings={**mount, **QUICK}) as slam:
        for k in range(11):
            frame = room[3 * k]
            images = (frame.color, frame.depth_m)
            if k in covered:
                images = tuple(map(np.zeros_like, images))
            pose = slam.track(*images, frames[k].stamp_ns, prior=T_other[3 * k])
            assert pose.status == ("LOST" if k in covered else "OK")
    moved = np.linalg.inv(truth.T_world_camera[0]) @ truth.T_world_camera[30]
    np.testing.assert_allclose(pose.T_odom_camera, moved, atol=2e-3)


@pytest.mark.parametrize(
    ("prior", "message"),
    [
        ("x", "prior is a str, must be an array"),
        (np.eye(3), r"prior has the shape \(3, 3\), must have the shape \(4, 4\)"),
        (2 * np.eye(4), "prior is not a rigid transform"),
        (np.full((4, 4), np.nan), "prior is not a rigid transform"),
        ([[1, 0], [0, 1]], "prior is a list, must be an array"),
    ],
)
def test_wrong_prior_is_named_and_tracking_continues(
    frames: list[Frame], prior: object, message: str
) -> None:
    first, second = frames[:2]
    with Slam(first.camera, settings=QUICK) as slam:
        slam.track(first.color, first.depth_m, first.stamp_ns)
        with pytest.raises(FrameError, match=message):
            slam.track(second.color, second.depth_m, second.stamp_ns, prior=prior)
        assert slam.track(second.color, second.depth_m, second.stamp_ns + 1).status == "OK"


def test_wrong_settings_and_cameras_are_refused(tmp_path: Path) -> None:
    camera = Camera(64, 48, 60.0, 60.0, 32.0, 24.0)
    with pytest.raises(ConfigError, match=r"mapper\.iteration"):
        Slam(camera, settings={"mapper.iteration": 3})
    with pytest.raises(ConfigError, match=r"nothing\.yaml"):
        Slam(camera, config=tmp_path / "nothing.yaml")
    with pytest.raises(ConfigError, match="Put the settings into this Config"):
        Slam(camera, config=load_config(), settings={"mapper.iterations": 3})
    for arguments, message in (
        ({"camera": (640, 480)}, r"ldo_service\.Camera"),
        ({"depth_scale": "1000"}, "depth_scale='1000'"),
        ({"depth_scale": 0}, "depth_scale=0"),
        ({"config": {"mapper.iterations": 3}}, "config is a dict"),
        ({"settings": ["mapper.iterations=3"]}, "settings is a list"),
        ({"settings": {"mapper.iterations": "7"}}, r"mapper\.iterations"),
        ({"settings": {"mapper.iterations": 7, "mapper.iterations.x": 7}}, r"mapper\.iterations"),
        ({"settings": {3: 7}}, "name of a setting is 3"),
        ({"settings": {"detector.model": "no such"}}, r"detector\.model=no such"),
    ):
        with pytest.raises(ConfigError, match=message):
            Slam(**{"camera": camera, **arguments})  # pyright: ignore[reportArgumentType]


def test_settings_may_come_from_a_file_and_a_mapping(tmp_path: Path) -> None:
    file = tmp_path / "slam.yaml"
    file.write_text("mapper: {iterations: 3}\n")
    camera = Camera(64, 48, 60.0, 60.0, 32.0, 24.0)
    with Slam(camera, config=file, settings={"tracker.self_calibration": False}) as slam:
        assert slam.config.mapper.iterations == 3
        assert not slam.config.tracker.self_calibration
    text = {"detector.model": "a: b #1", "mapper.iterations": np.int64(4)}
    config = load_config(values=text)
    assert (config.detector.model, config.mapper.iterations) == ("a: b #1", 4)


@pytest.mark.parametrize(
    ("T", "message"),
    [
        (None, "with status OK or WEAK"),
        (np.eye(3), "shape"),
        ("x", "is a str"),
        (2 * np.eye(4), "rigid"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "rigid"),
        (np.full((4, 4), np.nan), "rigid"),
    ],
)
def test_wrong_pose_of_a_rendering_is_refused(finished: Slam, T: object, message: str) -> None:
    with pytest.raises(ConfigError, match=f"T_map_camera.*{message}"):
        finished.map.render(T)  # pyright: ignore[reportArgumentType]


def test_wrong_options_of_a_rendering_are_refused(finished: Slam) -> None:
    for options, message in (
        ({"labels": True}, "no labels"),
        ({"threads": 0}, "threads=0"),
        ({"camera": (320, 240)}, "camera is a tuple"),
    ):
        with pytest.raises(ConfigError, match=message):
            finished.map.render(np.eye(4), **options)
    with pytest.raises(ConfigError, match="map is empty"):
        Slam(finished.camera).map.render(np.eye(4))


# --- life -----------------------------------------------------------------------------------------
def test_two_objects_side_by_side_do_not_disturb_each_other(
    frames: list[Frame], finished: Slam
) -> None:
    with Slam(frames[0].camera) as one, Slam(frames[0].camera) as other:
        for frame, behind in zip(frames, [*frames[:1], *frames], strict=False):
            one.track(frame.color, frame.depth_m, frame.stamp_ns)
            if behind is not frame:
                other.track(behind.color, behind.depth_m, behind.stamp_ns)
        one.finish()
    require_equal(one.trajectory(), finished.trajectory())
    assert len(other.trajectory()) == COUNT - 1


def test_close_ends_all_threads_and_keeps_the_results(frames: list[Frame]) -> None:
    before = set(threading.enumerate())
    slam = Slam(frames[0].camera, settings=QUICK)
    fed(slam, frames[:3])
    assert set(threading.enumerate()) > before
    slam.close()
    slam.close()
    assert set(threading.enumerate()) == before
    assert len(slam.trajectory()) == 3
    for call in (slam.finish, lambda: fed(slam, frames[3:4])):
        with pytest.raises(ConfigError, match="after close"):
            call()


def test_track_after_finish_is_refused(frames: list[Frame]) -> None:
    with Slam(frames[0].camera, settings=QUICK) as slam:
        fed(slam, frames[:2])
        slam.finish()
        slam.finish()
        with pytest.raises(ConfigError, match="after finish"):
            fed(slam, frames[2:3])


def interrupted(monkeypatch: pytest.MonkeyPatch, slam: Slam, name: str, times: int = 1) -> None:
    """Let the next call of a method of the actors receive Ctrl-C before it works."""
    method = getattr(slam._run, name)

    def call(*arguments: object) -> object:
        monkeypatch.setattr(slam._run, name, method)
        for _ in range(times):
            signal.raise_signal(signal.SIGINT)
        return method(*arguments)

    monkeypatch.setattr(slam._run, name, call)


def test_results_after_interrupts_are_those_without(
    frames: list[Frame], finished: Slam, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Slam(frames[0].camera) as slam:
        fed(slam, frames[:5])
        interrupted(monkeypatch, slam, "tick")
        with pytest.raises(KeyboardInterrupt):
            fed(slam, frames[5:6])
        fed(slam, frames[6:])
        interrupted(monkeypatch, slam, "end_stream")
        with pytest.raises(KeyboardInterrupt):
            slam.finish()
        with pytest.raises(ConfigError, match="after finish"):
            fed(slam, frames[:1])
        slam.finish()
    require_equal(slam.trajectory(), finished.trajectory())
    assert slam.map.arrays().means_m.tobytes() == finished.map.arrays().means_m.tobytes()


def test_interrupted_refinement_continues_with_the_next_call(
    frames: list[Frame], finished: Slam, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    colors = []
    for is_interrupted in (False, True):
        with Slam(frames[0].camera) as slam:
            fed(slam, frames)
            slam.finish()
            if is_interrupted:
                interrupted(monkeypatch, slam, "tick")
                with pytest.raises(KeyboardInterrupt):
                    slam.finish(refine_iterations=30)
                assert json.loads((slam.save(tmp_path / "a") / "summary.json").read_text())[
                    "interrupted"
                ]
                slam.finish()
            else:
                slam.finish(refine_iterations=30)
            colors.append(slam.map.arrays().colors.tobytes())
            summary = json.loads(
                (slam.save(tmp_path / f"{is_interrupted}") / "summary.json").read_text()
            )
            assert (summary["refine_iterations"], summary["interrupted"]) == (30, False)
    assert colors[0] == colors[1] != finished.map.arrays().colors.tobytes()


def test_second_interrupt_takes_effect_at_once_and_ends_tracking(
    frames: list[Frame], monkeypatch: pytest.MonkeyPatch
) -> None:
    with Slam(frames[0].camera, settings=QUICK) as slam:
        fed(slam, frames[:2])
        interrupted(monkeypatch, slam, "tick", times=2)
        with pytest.raises(KeyboardInterrupt):
            fed(slam, frames[2:3])
        with pytest.raises(StageError, match="KeyboardInterrupt interrupted a step"):
            fed(slam, frames[3:4])
        assert len(slam.trajectory()) == 2


def test_interrupt_while_closing_leaves_no_thread(
    frames: list[Frame], monkeypatch: pytest.MonkeyPatch
) -> None:
    before = set(threading.enumerate())
    slam = Slam(frames[0].camera, settings=QUICK)
    fed(slam, frames[:2])
    interrupted(monkeypatch, slam, "__exit__", times=2)
    with pytest.raises(KeyboardInterrupt):
        slam.close()
    slam.close()
    assert set(threading.enumerate()) == before


def test_failed_actor_ends_tracking_and_keeps_the_results(
    frames: list[Frame], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with Slam(frames[0].camera, settings=QUICK) as slam:
        fed(slam, frames[:4])

        def fail(_message: object) -> object:
            raise RuntimeError("out of ideas")

        monkeypatch.setattr(slam._run.actors["tracker"], "handle", fail)
        with pytest.raises(
            StageError,
            match="tracker failed at tick 4 of the logical clock: RuntimeError: out of ide",
        ):
            fed(slam, frames[4:5])
        for call in (slam.finish, lambda: fed(slam, frames[5:6])):
            with pytest.raises(StageError, match="not possible after a failure: tracker failed"):
                call()
        assert len(slam.trajectory()) == 4
        folder = slam.save(tmp_path / "run")
    assert json.loads((folder / "summary.json").read_text())["interrupted"]


def test_negative_number_of_iterations_is_refused(frames: list[Frame]) -> None:
    with Slam(frames[0].camera, settings=QUICK) as slam:
        for count in (-1, "5", 1.5):
            with pytest.raises(ConfigError, match="refine_iterations"):
                slam.finish(refine_iterations=count)  # pyright: ignore[reportArgumentType]


def test_time_between_frames_does_not_lower_the_frame_rate(
    frames: list[Frame], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s = iter(range(100))
    monkeypatch.setattr(Usage, "now", staticmethod(lambda: Usage(float(next(now_s)), 0.0)))
    with Slam(frames[0].camera, settings=QUICK) as slam:
        fed(slam, frames[:3])  # Each step takes one tick of the clock above.
        next(now_s)
        folder = slam.save(tmp_path / "run")
    assert json.loads((folder / "summary.json").read_text())["fps"] == 1.0


# --- saved runs -----------------------------------------------------------------------------------
def test_saved_run_has_the_map_and_the_trajectory(finished: Slam, saved: Path) -> None:
    run = Run.open(saved)
    assert len(run.map) == len(finished.map)
    pose = finished.trajectory().T_world_camera[-1]
    first, second = run.map.render(pose), finished.map.render(pose)
    np.testing.assert_allclose(first.color, second.color, atol=1e-3)
    np.testing.assert_allclose(
        run.trajectory().T_world_camera, finished.trajectory().T_world_camera, atol=1e-6
    )
    assert run.objects() == []


def test_saved_run_is_exported(saved: Path, tmp_path: Path) -> None:
    run = Run.open(saved)
    assert run.export("splat", tmp_path / "a.splat").stat().st_size == 32 * len(run.map)
    assert run.export("mesh", tmp_path / "a.ply", voxel_m=0.1).read_bytes()[:3] == b"ply"
    for change, message in (
        ({"format": "step"}, "'step' is unknown"),
        ({"out": saved / "map.ply"}, "output of the run"),
        ({"out": tmp_path / "a.splat"}, "exists"),
    ):
        with pytest.raises(ConfigError, match=message):
            run.export(**{"format": "splat", "out": tmp_path / "b.splat", **change})


def test_folder_that_is_not_empty_is_not_overwritten(finished: Slam, saved: Path) -> None:
    with pytest.raises(ConfigError, match=r"not empty.*overwrite=True"):
        finished.save(saved)
    finished.save(saved, overwrite=True)


def test_folder_without_a_map_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"has no map\.ply"):
        Run.open(tmp_path)


# --- import ---------------------------------------------------------------------------------------
def test_import_of_the_package_loads_no_numerical_code() -> None:
    program = (
        "import sys, ldo_service; from ldo_service import connect; dir(ldo_service); "
        "print(*sorted({'cv2', 'gtsam', 'scipy', 'onnxruntime'} & sys.modules.keys()))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == []


def test_every_public_name_is_there() -> None:
    for name in ldo_service.__all__:
        assert getattr(ldo_service, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'slam'"):
        ldo_service.slam  # noqa: B018
