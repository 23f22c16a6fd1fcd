"""Tests of the detector in its own process, with a network and with a damaged file."""

from pathlib import Path

import pytest

from ldo_service.schemas import DetectionBoxes
from tests.detection.networks import squares_network
from tests.service.conftest import live_service, wait_until

APART = ("--set", "service.process_actors=[detector]", "--set", "mapper.iterations=2")


@pytest.mark.slow
@pytest.mark.parametrize("is_garbage", [False, True], ids=["network", "garbage"])
def test_keyframes_get_a_detection_message_also_without_a_network(
    tmp_path: Path, is_garbage: bool
) -> None:
    model = squares_network("yolox", width=320, height=256).write(tmp_path / "squares.onnx")
    if is_garbage:
        model.write_bytes(b"garbage")
    use = ("--set", f"detector.model={model}", "--set", "detector.min_score=0")
    boxes: list[DetectionBoxes] = []
    with live_service(tmp_path, *APART, *use) as service:
        with service.client.poller("detection/boxes", DetectionBoxes, keep=64) as inbox:
            service.wait_for_actors()
            publisher = service.publisher("synthetic:room", "--rate", "8", "--max-frames", "40")
            service.wait_for_poses(12)
            wait_until(lambda: boxes.extend(inbox()) or len(boxes) >= 2, 10, "boxes")
            assert publisher.wait(60) == 0
            facts = service.update_health()["detector"].metrics
        assert facts["networks_missing"] == is_garbage
        assert {bool(message.detections) for message in boxes} == {not is_garbage}
        assert service.stop() == 0
        assert ("no network in ONNX" in service.log) == is_garbage
        assert "Traceback" not in service.log
