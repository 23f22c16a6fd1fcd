"""Labels of a run over a staged room, correct by ground truth or made wrong."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from ldo_service.datasets import Sequence, open_sequence
from ldo_service.detection.vocabulary import Vocabulary, coco_class
from ldo_service.errors import DataError
from ldo_service.evaluation.finished_run import FinishedRun, RunFrame
from ldo_service.evaluation.instances import InstancePrecision, mean_precision
from ldo_service.evaluation.label_measures import DetectionCounts
from ldo_service.evaluation.label_results import frames_to_show, plain_labels
from ldo_service.evaluation.results import NO_LABELS, NO_TRUTH
from ldo_service.evaluation.semantics import GATES, LabelErrors, ListErrors, evaluate_labels
from ldo_service.evaluation.views import EvaluatedFrames
from ldo_service.gaussians.model import new_labels
from ldo_service.geometry import se3
from ldo_service.geometry.sequence import FrameLabels
from ldo_service.runs.finished import read_run
from ldo_service.runs.folder import SEMANTICS
from ldo_service.runs.offline import run_offline
from ldo_service.runs.records import write_objects
from ldo_service.schemas import MapObject, MapObjects, Pose
from ldo_service.semantics.gaussian_labels import fields
from ldo_service.semantics.semantics_file import write_semantics
from tests.commands.test_cli import ldo
from tests.runs.jobs import job
from tests.semantics import scenes

FRAMES, SCALE = 9, 5000
THINGS = (
    *(
        replace(thing, name="desk") if thing.name == "dining table" else thing
        for thing in scenes.SCENE_OBJECTS[:4]
    ),
    replace(scenes.SCENE_OBJECTS[4], name="speaker"),
    replace(scenes.SCENE_OBJECTS[5], name="globe"),
)
CLASSES = ("undefined", "wall", *dict.fromkeys(thing.name for thing in THINGS))
COCO, ALL_NAMES = range(2)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the staged room in Replica's layout, 128x96; its chair is void."""
    folder = tmp_path_factory.mktemp("data") / "room"
    for kind in ("results", "semantic_class", "instance"):
        (folder / kind).mkdir(parents=True)
    poses = scenes.poses(100)[:FRAMES]
    for k, T_world_camera in enumerate(poses):
        write_shot(folder, k, scenes.shoot(THINGS, T_world_camera, k))
    np.savetxt(folder / "traj.txt", poses.reshape(FRAMES, 16))
    names = {str(k): name for k, name in enumerate(CLASSES)}
    names[str(CLASSES.index("chair"))] = "undefined"
    (folder / "labels.json").write_text(json.dumps({"classes": names}))
    camera = {name: getattr(scenes.CAMERA, name) for name in ("fx", "fy", "cx", "cy")}
    params = {"w": scenes.CAMERA.width, "h": scenes.CAMERA.height, **camera, "scale": SCALE}
    (folder / "cam_params.json").write_text(json.dumps({"camera": params}))
    return folder


def write_shot(folder: Path, k: int, shot: scenes.Shot) -> None:
    classes = np.array([1, *(CLASSES.index(thing.name) for thing in THINGS)], np.uint8)
    images = {
        f"results/frame{k:06d}.png": shot.frame.color[..., ::-1],
        f"results/depth{k:06d}.png": np.round(shot.frame.depth_m * SCALE).astype(np.uint16),
        f"semantic_class/{k:06d}.png": classes[shot.instances],
        f"instance/{k:06d}.png": shot.instances.astype(np.uint16),
    }
    for name, image in images.items():
        cv2.imwrite(str(folder / name), image)


@pytest.fixture(scope="module")
def sequence(folder: Path) -> Sequence:
    return open_sequence(str(folder))


@pytest.fixture(scope="module")
def unlabelled(sequence: Sequence, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run") / "room"
    run_offline(job(sequence, folder, "tracker.hold_out=5"), lambda *_: None)
    return folder


@pytest.fixture
def labelled(unlabelled: Path, sequence: Sequence, tmp_path: Path) -> Path:
    """Return a copy of the run in which each Gaussian has the true label of its pixel.

    A label has its name in COCO, or else its name in the data set.
    """
    folder = shutil.copytree(unlabelled, tmp_path / "run")
    run, names = read_run(folder), Vocabulary()
    labels = new_labels(len(run.maps[0].rows))
    for frame in run.frames:
        gaussians, class_ids = on_surfaces(sequence, run, frame)
        truth = sequence.true_labels()
        assert truth is not None
        known = [
            names.index(coco_class(name) or name) if is_object(name) else 0
            for name in truth.class_names
        ]
        fields(labels)["ids"][gaussians, 0] = np.array(known)[class_ids]
        fields(labels)["weights"][gaussians, 0] = 1
    write_semantics(folder / SEMANTICS, labels, names.names)
    return folder


def on_surfaces(
    sequence: Sequence, run: FinishedRun, frame: RunFrame
) -> tuple[np.ndarray, np.ndarray]:
    """Return Gaussians at the depth of their pixel, and the classes of these pixels."""
    shown, truth, posed = sequence[frame.index], sequence.true_labels(), run.maps[0]
    assert truth is not None
    p_camera = se3.transform(se3.inverse(posed.T_map_camera(frame)), posed.rows[:, :3])
    u, v = np.rint(shown.camera.project(p_camera)).astype(int).T
    height, width = shown.depth_m.shape
    i = np.flatnonzero((p_camera[:, 2] > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height))
    i = i[np.abs(shown.depth_m[v[i], u[i]] - p_camera[i, 2]) < 0.03]
    return i, truth.frame(frame.index).class_ids[v[i], u[i]]


def save_true_objects(folder: Path, sequence: Sequence, offset_m: float = 0.0) -> None:
    """Save an object for each true instance, with the box of its surface, moved along x."""
    run, truth = read_run(folder), sequence.true_labels()
    assert truth is not None
    points: dict[tuple[int, str], list[np.ndarray]] = {}
    for frame in run.frames:
        labels, shown = truth.frame(frame.index), sequence[frame.index]
        p_camera = shown.camera.backproject(shown.depth_m)
        p_map = se3.transform(run.maps[0].T_map_camera(frame), p_camera.reshape(-1, 3))
        for instance in np.unique(labels.instance_ids).tolist():
            mask = (labels.instance_ids == instance).ravel() & (shown.depth_m > 0).ravel()
            name = truth.class_names[labels.class_ids.ravel()[mask][0]]
            if is_object(name):
                points.setdefault((instance, coco_class(name) or name), []).append(p_map[mask])
    objects = (
        map_object(number, name, np.concatenate(of_views) + np.array([offset_m, 0, 0]))
        for number, ((_, name), of_views) in enumerate(sorted(points.items()))
    )
    found = MapObjects(stamp_ns=0, version=1, graph_version=1, objects=tuple(objects))
    write_objects(folder, found)


def map_object(number: int, name: str, p_map: np.ndarray) -> MapObject:
    low, high = p_map.min(axis=0), p_map.max(axis=0)
    x, y, z = ((low + high) / 2).tolist()
    width, height, depth = (high - low).tolist()
    return MapObject(
        id=number,
        name=name,
        confidence=0.9,
        centroid=(x, y, z),
        covariance=tuple(np.eye(3).ravel().tolist()),
        T_map_object=Pose(translation=(x, y, z), quaternion=(1.0, 0.0, 0.0, 0.0)),
        size=(width, height, depth),
        distribution=((name, 0.9),),
        entropy=0.5,
        observation_count=3,
        miss_count=0,
        first_keyframe=0,
        last_keyframe=2,
    )


def is_object(name: str) -> bool:
    return name not in ("", "undefined", "wall", "floor", "ceiling")


def renamed(folder: Path, other: dict[str, str]) -> Path:
    """Rename some labels of a run, and return its folder."""
    saved = read_run(folder).maps[0].semantics
    assert saved is not None
    names = tuple(other.get(name, name) for name in saved.names)
    write_semantics(folder / SEMANTICS, saved.labels, names)
    return folder


def errors_of(sequence: Sequence, folder: Path) -> LabelErrors:
    run = read_run(folder)
    (errors,) = evaluate_labels(sequence, run, EvaluatedFrames.of(run.frames), lambda _done: None)
    return errors


def test_map_with_true_labels_scores_high(sequence: Sequence, labelled: Path) -> None:
    errors = errors_of(sequence, labelled)
    coco, full = errors.lists
    assert (coco.labels.name, full.labels.name) == ("COCO", "all names")
    assert "chair" not in coco.labels.names, "void"
    for row in errors.lists:
        assert row.frames == (4, 0, 6), "held out, then every fifth of the others"
        found = row.figures(GATES["from 0.2 %"])
        assert found.mean_iou > 0.8
        assert found.object_iou > 0.75
        assert found.pixel_accuracy > 0.95
        assert row.figures(0).classes >= found.classes >= 4
        assert 0.7 < row.per_image_iou() <= 1
    assert (errors.pairs, errors.consistency.share > 0.9) == (2, True), "0 to 3, and 4 to 7"
    assert errors.objects == DetectionCounts(right=2, wanted=2, named=2), "speaker and globe"
    assert errors.pixels.recall > 0.9
    assert errors.pixels.precision > 0.9


def test_true_objects_have_a_high_precision_and_displaced_ones_none(
    capsys, sequence: Sequence, labelled: Path, folder: Path
) -> None:
    assert errors_of(sequence, labelled).lists[COCO].instances is None, "no objects.json"
    save_true_objects(labelled, sequence)
    of_coco, of_all = (row.instances for row in errors_of(sequence, labelled).lists)
    assert of_coco is not None
    assert of_all is not None
    assert of_coco.keys() < of_all.keys()
    assert {"speaker", "globe"} < of_all.keys()
    mean = mean_precision(of_all)
    assert mean.ap50 == 1
    assert mean.ap > 0.7
    code, out, _ = ldo(capsys, "eval", labelled, folder, "--json")
    assert code == 0
    plain = json.loads(out)["labels"][0]["lists"]["all names"]["instances"]
    assert plain["ap50"] == 1
    assert InstancePrecision(**plain["classes"]["globe"]) == of_all["globe"]
    _, out, _ = ldo(capsys, "eval", labelled, folder)
    assert "AP50" in out
    row = next(line for line in out.splitlines() if "all names" in line and "100.0%" in line)
    assert f"{mean.ap:.1%}" in row
    save_true_objects(labelled, sequence, offset_m=3.0)
    displaced = errors_of(sequence, labelled).lists[ALL_NAMES]
    assert displaced.instances
    assert mean_precision(displaced.instances).ap25 == 0
    assert displaced.figures(0).mean_iou > 0.7, "the labels of the pixels are still right"


def test_wrong_names_lower_the_scores_but_not_consistency(
    sequence: Sequence, labelled: Path
) -> None:
    right = errors_of(sequence, labelled)
    wrong = errors_of(sequence, renamed(labelled, {"couch": "elephant", "globe": "samovar"}))
    couches, elephants = (row.lists[COCO].labels.names.index("couch") for row in (right, wrong))
    assert right.lists[COCO].pooled[couches, couches] > 1000
    assert wrong.lists[COCO].pooled[elephants, elephants] == 0
    assert wrong.consistency == right.consistency, "consistency does not depend on the truth"
    assert wrong.objects.named == right.objects.named
    assert wrong.objects.right < right.objects.right
    assert wrong.lists[ALL_NAMES].figures(0).pixel_accuracy < (
        right.lists[ALL_NAMES].figures(0).pixel_accuracy - 0.05
    )


def test_detector_labels_have_no_recall_beyond_coco(sequence: Sequence, labelled: Path) -> None:
    saved = read_run(labelled).maps[0].semantics
    assert saved is not None
    labels = saved.labels.copy()
    beyond = fields(labels)["ids"][:, 0] >= 82
    fields(labels)["weights"][beyond] = 0
    write_semantics(labelled / SEMANTICS, labels, saved.names[:82])
    errors = errors_of(sequence, labelled)
    assert errors.objects.recall == 0
    assert np.isnan(errors.objects.precision)
    assert errors.lists[COCO].figures(0).object_iou > 0.7


def test_eval_command_prints_protocol_and_tables_and_saves_labels_png(
    capsys, labelled: Path, folder: Path
) -> None:
    code, out, _ = ldo(capsys, "eval", labelled, folder, "--protocol")
    assert code == 0
    parts = (
        "PSNR dB",
        "Labels are rendered",
        "labeller: none",
        "COCO, from 0.2 %",
        "all names, all",
        "consistency",
    )
    assert [out.index(part) for part in parts] == sorted(out.index(part) for part in parts)
    sheet = cv2.imread(str(labelled / "labels.png"))
    assert sheet is not None
    assert sheet.shape[0] > 3 * 96, "the sheet has a row for each frame"


def test_json_has_every_measure_of_every_list(capsys, labelled: Path, folder: Path) -> None:
    code, out, _ = ldo(capsys, "eval", labelled, folder, "--json")
    assert code == 0
    found = json.loads(out)
    (row,) = found["labels"]
    errors = errors_of(open_sequence(str(folder)), labelled)
    assert row == json.loads(json.dumps(plain_labels(errors)))
    assert row["lists"]["COCO"]["classes"]["couch"]["iou"] > 0.8
    assert row["lists"]["COCO"]["all"]["mean_iou"] > 0.7
    assert found["vlm_calls_per_frame"] == 0
    assert found["labelled_by"] == {"detector": "", "labeller": ""}
    assert "Consistency" in found["protocol"]["labels"]


@pytest.mark.parametrize(
    ("summary", "expected"),
    [('{"labeller_requests": 3}', pytest.approx(1 / 3)), ("{}", None), ("[", None), (None, None)],
)
def test_labeller_calls_are_read_from_the_summary_of_the_run(
    capsys, labelled: Path, folder: Path, summary: str | None, expected
) -> None:
    (labelled / "summary.json").unlink()
    if summary is not None:
        (labelled / "summary.json").write_text(summary)
    _, out, _ = ldo(capsys, "eval", labelled, folder, "--json")
    assert json.loads(out)["vlm_calls_per_frame"] == expected


def test_missing_labels_of_run_or_truth_are_reported(
    capsys, unlabelled: Path, labelled: Path, folder: Path, tmp_path: Path
) -> None:
    run = shutil.copytree(unlabelled, tmp_path / "plain")
    _, out, _ = ldo(capsys, "eval", run, folder)
    assert NO_LABELS in " ".join(out.split())
    assert not (run / "labels.png").exists()
    without_truth = shutil.copytree(folder, tmp_path / "without_truth")
    (without_truth / "labels.json").unlink()
    _, out, _ = ldo(capsys, "eval", labelled, without_truth)
    assert NO_TRUTH in " ".join(out.split())
    assert "mIoU" not in out
    _, out, _ = ldo(capsys, "eval", run, without_truth)
    assert NO_TRUTH not in " ".join(out.split())
    assert NO_LABELS not in " ".join(out.split())


def test_labels_of_another_size_are_a_data_error(
    monkeypatch, sequence: Sequence, labelled: Path
) -> None:
    truth = sequence.true_labels()
    assert truth is not None

    def halved(index: int) -> FrameLabels:
        whole = truth.frame(index)
        return replace(whole, class_ids=whole.class_ids[::2])

    monkeypatch.setattr(sequence, "true_labels", lambda: replace(truth, frame=halved))
    with pytest.raises(DataError, match="Export the labels at the size"):
        errors_of(sequence, labelled)


def test_shown_frames_include_the_worst_and_the_best() -> None:
    def half_right(share: float) -> np.ndarray:
        return np.array([[50, 0, 0], [round(100 * (1 - share)), round(100 * share), 0]])

    shares = (0.5, 0.1, 0.9, 0.2, 0.6, 0.7, 0.3, 0.4)
    almost_empty = np.array([[99, 1, 0], [0, 0, 0]])
    rows = (*map(half_right, shares), almost_empty)
    chosen = frames_to_show(ListErrors(None, tuple(range(10, 19)), rows), count=4)  # type: ignore[arg-type]
    assert [frame for frame, _ in chosen] == sorted(frame for frame, _ in chosen)
    notes = dict(chosen)
    assert notes[11] == "frame 11: 10% right, the worst"
    assert notes[12] == "frame 12: 90% right, the best"
    assert len(chosen) == 4
    assert 18 not in notes, "a frame with almost no object is not shown"
    assert frames_to_show(ListErrors(None, (3,), (almost_empty,))) == []  # type: ignore[arg-type]
