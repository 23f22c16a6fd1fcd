"""Target scores of the whole service on the flat with the built-in networks.

The test takes ten minutes; run it with `pytest -m slow tests/runs`.
"""

import json
import subprocess
from pathlib import Path
from typing import Any

import pytest

from tests.service.conftest import LDO

NETWORKS = ("--set", "detector.model=demo", "--set", "vlm_labeller.model=demo")


def ldo(*words: str | Path) -> str:
    """Run a command and return its standard output."""
    done = subprocess.run([*LDO, *map(str, words)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_flat_reaches_target_scores_of_poses_map_labels_and_loops(tmp_path: Path) -> None:
    folder = tmp_path / "flat"
    ldo("run", "synthetic:flat", "--out", folder, "--hold-out-every", "5", *NETWORKS)
    scores: dict[str, Any] = json.loads(ldo("eval", folder, "synthetic:flat", "--json"))
    (labels,), loops = scores["labels"], scores["loops"]
    assert scores["trajectory"]["final"]["ate_m"]["rmse"] < 0.005
    held_out = scores["rendering"][0]
    assert held_out["protocol"] == "A held out"
    assert held_out["mean"]["psnr_db"] > 35
    assert labels["lists"]["COCO"]["from 0.2 %"]["object_iou"] >= 0.60
    assert labels["consistency"] >= 0.87
    beyond_coco = labels["beyond_coco"]["objects"]
    assert beyond_coco["recall"] >= 0.78
    assert beyond_coco["precision"] >= 0.70
    assert loops["precision"] >= 0.99
    assert loops["recall"] >= 0.88
