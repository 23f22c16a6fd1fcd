"""Objects of a service whose back ends are slow at first, simulated in logical time."""

from collections import Counter
from pathlib import Path

import pytest

from ldo_service.conversions.frames import raw_frame_to_message
from ldo_service.synthetic import SyntheticSequence
from tests.bench.bench_late_labels import SLOW_BACKENDS, Run, matched

SETTINGS = ["detector.model=demo", "vlm_labeller.model=demo", "mapper.iterations=4"]
FRAMES, HZ = 100, 3.0


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_objects_have_the_same_names_after_slow_back_ends_have_recovered(tmp_path: Path) -> None:
    sequence = SyntheticSequence.named("tour-noisy")
    frames = [raw_frame_to_message(sequence.read(index)) for index in range(FRAMES)]
    runs = {}
    for slowed in ("nothing", "vlm_labeller"):
        folder = tmp_path / slowed
        folder.mkdir()
        run = runs[slowed] = Run(SLOW_BACKENDS[slowed], SETTINGS, folder)
        run.run(frames, HZ)
        assert run.service.actor("mapper").metrics()["keyframes_to_relabel"] == 0
    prompt, late = runs["nothing"].objects, runs["vlm_labeller"].objects
    assert runs["vlm_labeller"].service.actor("mapper").metrics()["labels_reordered"] == 1
    assert len(prompt) > 5
    assert Counter(one.name for one in late) == Counter(one.name for one in prompt)
    assert matched(late, prompt) == len(prompt)
