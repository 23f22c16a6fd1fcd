"""What the whole service reaches on the flat with the built-in networks: no less than was aimed.

A pass takes some ten minutes, so these do not run with the others: `pytest -m slow tests/runs`.
"""

import json
import subprocess
from pathlib import Path
from typing import Any

import pytest

from tests.service.conftest import LDO

NETWORKS = ("--set", "detector.model=demo", "--set", "vlm_labeller.model=demo")


def ldo(*words: str | Path) -> str:
    """What a command prints."""
    done = subprocess.run([*LDO, *map(str, words)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_the_flat_is_mapped_named_and_closed_as_well_as_was_aimed_at(tmp_path: Path) -> None:
    folder = tmp_path / "flat"
    ldo("run", "synthetic:flat", "--out", folder, "--hold-out-every", "5", *NETWORKS)
    judged: dict[str, Any] = json.loads(ldo("eval", folder, "synthetic:flat", "--json"))
    (labels,), loops = judged["labels"], judged["loops"]
    assert judged["trajectory"]["final"]["ate_m"]["rmse"] < 0.005
    held_out = judged["rendering"][0]
    assert held_out["protocol"] == "A held out"
    assert held_out["mean"]["psnr_db"] > 35
    assert labels["lists"]["COCO"]["from 0.2 %"]["object_iou"] >= 0.60
    assert labels["consistency"] >= 0.87
    beyond = labels["beyond_coco"]["objects"]
    assert beyond["recall"] >= 0.78
    assert beyond["precision"] >= 0.70
    assert loops["precision"] >= 0.99
    assert loops["recall"] >= 0.88
