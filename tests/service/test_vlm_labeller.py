"""Tests of labels in a live service: labels added while it runs, and a slow labeller."""

import subprocess
from pathlib import Path

import numpy as np
import pytest

from ldo_service.datasets import Sequence
from ldo_service.errors import ConfigError
from ldo_service.geometry import se3
from ldo_service.schemas import LabelNames, MapDelta, MapObject, MapObjects
from ldo_service.schemas.topics import LABEL_NAMES
from ldo_service.synthetic.flat import FlatSequence
from tests.detection.labellers.encoders import ColorPair, vocabulary
from tests.detection.labellers.server import hangs, replies_with, serving
from tests.service.conftest import LDO, live_service, wait_until


def test_label_is_added_while_the_service_runs(tmp_path: Path) -> None:
    ColorPair().image(tmp_path / "model.onnx")
    ColorPair().text(tmp_path / "text.onnx")
    vocabulary(tmp_path / "bpe.txt.gz")
    (tmp_path / "names.txt").write_text("red\n")
    use = ("--set", f"vlm_labeller.model={tmp_path}")
    use += ("--set", f"vlm_labeller.class_names={tmp_path / 'names.txt'}")
    with live_service(tmp_path, *use) as service:
        service.wait_for_actors()
        command = [*LDO, "control", "add-label", "fire hydrant", "--endpoint", service.endpoint]
        done = subprocess.run(command, capture_output=True, text=True)
        assert (done.returncode, "from 2 names" in done.stdout) == (0, True), done.stderr
        (last,) = service.client.latest(LABEL_NAMES, timeout_s=60)
        assert isinstance(last, LabelNames)
        assert last.names == ("red", "fire hydrant")
        with pytest.raises(ConfigError, match="cannot be added: name has 101"):
            service.client.add_label("x" * 101)

        def is_counted() -> bool:
            return service.update_health()["vlm_labeller"].metrics.get("names_added") == 1

        wait_until(is_counted, 5, "counted")
        assert service.stop() == 0
        assert "Traceback" not in service.log


LIGHT = ("--set", "mapper.iterations=2")


def labeller_settings(url: str, *settings: str) -> tuple[str, ...]:
    use = (f"vlm_labeller.url={url}", *(f"vlm_labeller.http.{s}" for s in settings))
    return (*LIGHT, *(word for setting in use for word in ("--set", setting)))


@pytest.mark.slow
def test_added_label_is_used_for_later_regions(tmp_path: Path, room: Sequence) -> None:
    """The server always returns this label, which is rejected unless it is on the list."""
    (tmp_path / "names.txt").write_text("red\n")
    names = ("--set", f"vlm_labeller.class_names={tmp_path / 'names.txt'}")
    with (
        serving(replies_with("fire hydrant", 0.9)) as server,
        live_service(tmp_path, *labeller_settings(server.url), *names) as service,
        service.client.poller("map/delta", MapDelta) as deltas,
    ):
        service.wait_for_actors()
        with pytest.raises(ConfigError, match=r"no objects yet\. Objects appear with"):
            service.client.objects(timeout_s=1)
        assert "fire hydrant" in service.client.add_label("fire hydrant")
        received_labels: set[str] = set()

        def is_used() -> bool:
            received_labels.update(name for delta in deltas() for name in delta.label_names)
            return "fire hydrant" in received_labels

        with service.camera(room):
            wait_until(is_used, 30, "used")
        objects = service.client.objects(timeout_s=60).objects
        assert {one.name for one in objects} <= {"fire hydrant"}
        assert service.stop() == 0
        assert "Traceback" not in service.log


@pytest.mark.slow
def test_slow_labeller_delays_no_poses(tmp_path: Path, room: Sequence) -> None:
    """Frames have poses while the labeller waits for its first reply, and it adds no label."""
    slow = labeller_settings("", "timeout_s=14.0", "max_attempts=1")
    with serving(hangs) as server:
        use = [word.replace("url=", f"url={server.url}") for word in slow]
        with live_service(tmp_path, *use) as service:
            service.wait_for_actors()

            def is_reported() -> bool:
                return service.update_health()["vlm_labeller"].metrics.get("labeller_failing") == 1

            with service.camera(room):
                wait_until(lambda: len(server.requests) > 0, 20, "asked")
                service.poses()
                poses = service.wait_for_poses(10)
                assert not is_reported(), "the poses came after the first request had failed"
            assert {pose.status for pose in poses} == {"OK"}
            wait_until(is_reported, 15, "reported")
            assert service.client.objects().objects == ()
            server.ended.set()
            assert service.stop() == 0
            assert "Traceback" not in service.log


# Instance of a picture in the flat. It is completely visible in frame 30 and has no COCO class.
PICTURE = 9


@pytest.mark.slow
def test_object_gets_a_label_that_was_added_while_running(tmp_path: Path) -> None:
    """The built-in networks label the flat from a list that lacks this label."""
    (tmp_path / "names.txt").write_text("couch\nlamp\ncabinet\nwindow\ndoor\n")
    demo = ("detector.model=demo", "vlm_labeller.model=demo", "mapper.iterations=2")
    use = (*demo, f"vlm_labeller.class_names={tmp_path / 'names.txt'}")
    with (
        live_service(tmp_path, *(word for one in use for word in ("--set", one))) as service,
        service.client.poller("map/objects", MapObjects) as objects,
    ):
        service.wait_for_actors()
        publisher = service.publisher("synthetic:flat", "--rate", "1", "--max-frames", "50")
        service.wait_for_poses(4, timeout_s=60)
        assert "picture frame" in service.client.add_label("picture frame")
        p_picture, found = _observed_center(PICTURE, 30), list[MapObject]()

        def is_found() -> bool:
            found[:] = [one for message in objects() for one in message.objects] or found
            named = [one for one in found if one.name == "picture frame"]
            return any(np.linalg.norm(np.subtract(o.centroid, p_picture)) < 0.3 for o in named)

        wait_until(is_found, 60, "found")
        publisher.kill()
        publisher.wait()
        assert service.stop() == 0
        assert "Traceback" not in service.log


def _observed_center(instance: int, frame: int) -> np.ndarray:
    """Return the median position of an instance as seen in a frame of the flat.

    The position [3] is in meters, in the map frame, which is the frame of the first camera.
    """
    sequence = FlatSequence.named("flat")
    truth, T = sequence.labels(frame), sequence.truth().T_world_camera
    depth_m, camera = sequence[frame].depth_m, sequence.camera
    v, u = np.nonzero((truth.instance_ids == instance) & (depth_m > 0))
    z = depth_m[v, u]
    p_camera = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z])
    T_map_camera = se3.inverse(T[0]) @ T[frame]
    return T_map_camera[:3, :3] @ np.median(p_camera, axis=1) + T_map_camera[:3, 3]
