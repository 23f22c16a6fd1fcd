"""Fixtures that several test packages share."""

import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from ldo_service.config import load_config
from ldo_service.datasets import Cached, Sequence, open_sequence
from ldo_service.runs.folder import CAMERA, prepare
from ldo_service.runs.job import RunOptions
from ldo_service.runs.offline import run_offline
from ldo_service.runs.source import Selection


@pytest.fixture(scope="session")
def room() -> Sequence:
    """Return the synthetic room with exact ground truth; frames are rendered once per session."""
    return Cached(open_sequence("synthetic:room"))


@pytest.fixture(scope="session")
def room_folder(room: Sequence, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the first 16 frames of the room and their ground truth, as TUM RGB-D."""
    folder = tmp_path_factory.mktemp("data") / "room"
    lines = []
    for kind in ("rgb", "depth"):
        (folder / kind).mkdir(parents=True)
    for index in range(16):
        frame = room[index]
        name = f"{frame.stamp_ns * 1e-9:.6f}"
        cv2.imwrite(str(folder / f"rgb/{name}.png"), frame.color[..., ::-1])
        depth = np.round(frame.depth_m * 5000).astype(np.uint16)
        cv2.imwrite(str(folder / f"depth/{name}.png"), depth)
        lines.append(name)
    for kind in ("rgb", "depth"):
        text = "".join(f"{name} {kind}/{name}.png\n" for name in lines)
        (folder / f"{kind}.txt").write_text(text)
    intrinsics = {name: getattr(room.camera, name) for name in CAMERA}
    (folder / "camera.json").write_text(json.dumps(intrinsics))
    truth = room.truth()
    assert truth is not None
    truth.save(folder / "groundtruth.txt")
    return folder


@pytest.fixture(scope="session")
def finished_run(room_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the output of `ldo run --hold-out-every 5` on `room_folder`; tests only read it."""
    folder = tmp_path_factory.mktemp("run") / "room"
    prepare(folder, overwrite=False)
    config = load_config(settings=("tracker.hold_out=5", "mapper.threads=1"))
    job = RunOptions(open_sequence(str(room_folder)), folder, config, Selection(), print)
    run_offline(job, lambda *_: None)
    return folder


@pytest.fixture(scope="session")
def data() -> Path:
    """Return the folder of the data sets, LDO_DATA; skip the test if it is not set."""
    folder = os.environ.get("LDO_DATA")
    if not folder:
        pytest.skip("set LDO_DATA to a folder with tum/kitchen and replica/apartment_floor1")
    return Path(folder)
