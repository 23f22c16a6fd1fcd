"""Training, export and scoring of the built-in networks: a detector and a dual encoder.

    python training/train_demo.py [--out DIR] [--work DIR] [--share SHARE]

The program runs these steps:

1. Render random rooms in two processes.
2. Train the detector's proposal network and the dual encoder in parallel, one thread each.
3. Calibrate the confidences on separate rooms, and write the ONNX files.
4. Score the files on a third set of rooms and, at the very end, on `synthetic:flat`.

No choice depends on the final scores. Two runs on one machine write the same bytes.
"""

import argparse
import json
import logging
import os
import resource
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

# One thread per operation keeps the order of sums independent of the number of cores.
os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ["JAX_PLATFORMS"] = "cpu"

import card
import cells
import cv2
import detector
import encoder
import numpy as np
import pair
import scores
import second_look
from detector import FirstStage
from encoder import Pair
from flat_frames import flat_frames
from material import Rooms, render_all
from views import Views, VisibleBoxes
from wear import degrade

# Rooms for training, calibration of the confidences, and scores: seeds, and frames per room.
TRAINING = Rooms(range(200, 488), 8)
CALIBRATION = Rooms(range(160, 172), 12)
HELD_OUT = Rooms(range(172, 190), 12)
SEED = 0
# Maximum difference between the scores of detector.onnx and those of `second_look.output`. The two
# resize crops in different ways, so the scores are not equal.
APART = 0.2
STEPS = {"detector": (1900, 1400), "encoder": (5500, 6500)}  # Steps of each of the two rounds.
FLAT_STRIDE = 8  # Every 8th frame of the flat is scored.
SHIPPED = Path(__file__).parents[1] / "ldo_service" / "demo_networks"

log = logging.getLogger(__name__)


def main() -> None:
    """Render the rooms, train and export the networks, and write their scores and model card."""
    given = _arguments()
    given.out.mkdir(parents=True, exist_ok=True)
    started = time.monotonic()
    # Rooms.
    render_all([TRAINING, CALIBRATION, HELD_OUT], given.work, processes=2)
    rendering_s = _children_s()
    # Networks, one process each.
    steps = {
        name: [max(1, round(given.share * count)) for count in counts]
        for name, counts in STEPS.items()
    }
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        first = pool.submit(train_detector, given.work, steps["detector"])
        both = pool.submit(train_encoder, given.work, steps["encoder"])
        export(first.result(), both.result(), given.work, given.out)
    training_s = _children_s() - rendering_s
    # Scores.
    report = score(given.work, given.out)
    report["seed"] = SEED
    report["steps"] = {name: sum(counts) for name, counts in steps.items()}
    report["cpu_min"] = {
        "rendering": round(rendering_s / 60, 1),
        "training": round(training_s / 60, 1),
    }
    (given.out / "scores.json").write_text(json.dumps(report, indent=1) + "\n")
    (given.out / "CARD.md").write_text(card.written(report, given.out))
    log.info(
        "networks, scores and card written to %s in %.0f s", given.out, time.monotonic() - started
    )


def _children_s() -> float:
    """Return the CPU time of the child processes that have ended, seconds."""
    return sum(resource.getrusage(resource.RUSAGE_CHILDREN)[:2])


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=SHIPPED)
    parser.add_argument("--work", type=Path, default=Path("build/networks"))
    parser.add_argument(
        "--share",
        type=float,
        default=1.0,
        help="fraction of the training steps; less is faster and gives worse networks",
    )
    start_logging()
    return parser.parse_args()


def start_logging() -> None:
    """Log to stderr, and use one thread in OpenCV."""
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(name)s: %(message)s")
    cv2.setNumThreads(1)


def train_detector(work: Path, steps: Sequence[int]) -> FirstStage:
    """Train the detector's proposal network; this runs in a process of its own."""
    start_logging()
    return detector.train(TRAINING.load(work), steps, SEED)


def train_encoder(work: Path, steps: Sequence[int]) -> Pair:
    """Train the dual encoder; this runs in a process of its own."""
    start_logging()
    return pair.train(TRAINING.load(work), steps, SEED)


def export(first: FirstStage, both: Pair, work: Path, out: Path) -> None:
    """Calibrate and write the networks, and compare the files with the trained networks.

    Args:
        first: Trained proposal network.
        both: Trained dual encoder.
        work: Folder of the rendered rooms.
        out: Folder for the files.

    Raises:
        SystemExit: If the outputs of a file and of the trained network differ by more than the
            tolerance.
    """
    views = CALIBRATION.load(work)
    colors = _as_recorded(views)
    _export_labeller(both, views, colors, out)
    # The detector only classifies boxes of objects. Its copy of the dual encoder therefore lacks
    # NO_NAME and is calibrated on crops of objects.
    things = replace(both, texts=both.texts[: len(encoder.NAMES)], names=encoder.NAMES)
    crops, names = encoder.crops_of(views.seen, colors)
    is_right = names[:, None] == np.arange(len(things.names))
    scale = encoder.fitted_scale(things.images(crops), things.texts, is_right)
    second_look.export(first, things, scale, out / "detector.onnx")
    network = scores.session(out / "detector.onnx")
    for canvas in map(scores.canvas, colors[:4]):
        theirs = scores.output(network, canvas)
        mine = second_look.output(first, things, scale, canvas, theirs[:, 4:].any(axis=1))
        sides = np.maximum(theirs[:, 2:4].max(axis=1, keepdims=True), cells.STRIDES_PX[-1])
        boxes = mine[:, :4] / sides, theirs[:, :4] / sides
        _require_equal("boxes of detector.onnx (relative to their sides)", *boxes, 0.05)
        _require_equal("scores of detector.onnx", mine[:, 4:], theirs[:, 4:], APART)


def _export_labeller(both: Pair, views: Views, colors: Sequence[np.ndarray], out: Path) -> None:
    """Write the labeller's files, with confidences calibrated on region proposals."""
    crops, names = pair.crops_of(views.regions, colors)
    images = both.images(crops)
    encoder.export(both, encoder.fitted_scale(images, both.texts, pair.is_right(names)), out)
    theirs = scores.embedded(scores.session(out / "image_encoder.onnx"), crops)
    _require_equal("image_encoder.onnx", images, theirs, 2e-2)


def _require_equal(what: str, mine: np.ndarray, theirs: np.ndarray, tolerance: float) -> None:
    apart = float(np.abs(mine - theirs).max())
    if apart > tolerance:
        raise SystemExit(
            f"{what}: output differs from the trained network by {apart:g}; expected at most "
            f"{tolerance:g}. Check the export in training/layers.py."
        )
    log.info("%s: equal to the trained network within %.2g", what, apart)


def score(work: Path, out: Path) -> dict:
    """Return the scores of the trained networks on the held-out rooms and on `synthetic:flat`.

    Args:
        work: Folder with the rendered rooms.
        out: Folder with the ONNX files of the networks.
    """
    held_out = HELD_OUT.load(work)
    colors, seen = flat_frames(FLAT_STRIDE)
    return {
        "held_out": _scored(out, _as_recorded(held_out), held_out.seen)
        | {"regions": _regions_scored(out, held_out)},
        "flat": _scored(out, colors, seen),
    }


def _as_recorded(views: Views) -> list[np.ndarray]:
    """Return the frames with simulated camera errors, which are the same in each call."""
    return [
        degrade(color, np.random.default_rng([SEED, 3, k])) for k, color in enumerate(views.colors)
    ]


def _scored(out: Path, colors: list[np.ndarray], seen: VisibleBoxes) -> dict:
    network = scores.session(out / "detector.onnx")
    found = [scores.find(network, color) for color in colors]
    scale = scores.FRAME_PX[0] / colors[0].shape[1]
    per_class = scores.detection(found, seen.scaled(scale))
    crops, truth = encoder.crops_of(seen, colors)
    pixels = encoder.learnable(seen)[0].pixels
    is_large = pixels >= card.LARGE_SHARE * colors[0][..., 0].size
    return {
        "frames": len(colors),
        "mAP50": scores.mean_average_precision(per_class),
        "detector": {name: vars_of(one) for name, one in per_class.items()},
        "encoder": card.naming_report(scores.naming(out, crops, truth), is_large),
    }


def _regions_scored(out: Path, views: Views) -> dict:
    crops, truth = pair.crops_of(views.regions, _as_recorded(views))
    return card.regions_report(scores.naming(out, crops, truth))


def vars_of(one: scores.ClassScore) -> dict[str, float]:
    """Return the fields of a score, rounded to 4 digits."""
    return {name: round(getattr(one, name), 4) for name in one.__slots__}


if __name__ == "__main__":
    main()
