"""Accuracy of the map's labels by fusion rule, compared with painting each frame on its own.

    LDO_WEIGHTS=... python tests/bench/bench_labels.py [SOURCE] [--only TEXT] [--pictures DIR]
                                                       [--fusion P] [--background NAME ...]
    python tests/bench/bench_labels.py synthetic:flat --detectors demo --painted

SOURCE needs true labels and true poses. Every second frame is a keyframe at its true pose. Labels
are fused as the map grows. At the end they are evaluated on all frames as by `ldo eval`. The
classes are background and the COCO classes with at least 0.2 % of the pixels, in brackets all that
occur. `--background` names classes that count as background, whatever their synonyms. `--detectors`
are names or files as in `detector.model`, in place of those in LDO_WEIGHTS. `--painted` skips the
map.

"true boxes" are the boxes of the true objects that cover 0.5 % of the pixels, each with score 1.

`--fusion P` adds an oracle in place of the labeller. It labels each region with a detector score
below 0.6 at once, with confidence P. With probability P (seeded) the label is the true name of most
of the region's foreground, otherwise any name of the source.
"""

import argparse
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from ldo_service.datasets import open_sequence
from ldo_service.detection.detectors import NetworkConfig
from ldo_service.detection.open_networks import open_detector
from ldo_service.detection.vocabulary import Vocabulary
from ldo_service.evaluation.label_lists import VOID, coco_list, is_void
from ldo_service.evaluation.label_measures import Correspondences, correspondences
from ldo_service.evaluation.label_results import LabelPicture, label_sheet
from ldo_service.evaluation.semantics import APART, GATES, LabelErrors, LabelEvaluator, LabelView
from ldo_service.gaussians.map_builder import MapBuilder
from ldo_service.gaussians.renderer import Rendering
from ldo_service.geometry import RgbdFrame, se3
from ldo_service.geometry.sequence import FrameLabels, TrueLabels
from ldo_service.regions.foreground import (
    ForegroundConfig,
    RegionDetections,
    SmoothSurfaces,
    foreground,
    pixels_of,
    surfaces,
)
from ldo_service.regions.region_proposals import RegionProposalConfig
from ldo_service.semantics.gaussian_labels import BACKGROUND, LabelConfig, new_labels, top_labels
from ldo_service.semantics.label_assignment import AssignmentConfig
from ldo_service.semantics.semantic_fusion import (
    FusionConfig,
    SemanticFusionConfig,
    fuse_detections,
    label_image,
)

NETWORKS = {"YOLOX-Nano": "yolox_nano.onnx", "YOLOv5n": "yolov5n_480x640_w16.onnx"}
TRUE_BOXES, MIN_SHARE = "true boxes", 0.005
DEFAULT = "foreground coverage corrected"


@dataclass(frozen=True)
class Scene:
    """Frames with their true poses and labels, and the vocabulary of the labels."""

    frames: list[RgbdFrame]
    T_map_camera: np.ndarray
    truth: TrueLabels
    vocabulary: Vocabulary

    @cached_property
    def pairs(self) -> list[Correspondences]:
        """Correspondences of each frame and the one three frames later."""
        T, frames = self.T_map_camera, self.frames
        return [
            correspondences(frames[k], frames[k + APART], se3.inverse(T[k + APART]) @ T[k])
            for k in range(len(frames) - APART)
        ]

    @staticmethod
    def of(source: str, most: int | None, background: Sequence[str]) -> "Scene":
        sequence = open_sequence(source)
        poses, truth = sequence.truth(), sequence.true_labels()
        assert poses is not None, f"{source} has no true poses"
        assert truth is not None, f"{source} has no true labels"
        frames = [sequence[k] for k in range(len(sequence))[:most]]
        T = np.asarray(poses.T_world_camera)[: len(frames)]
        names = tuple("wall" if name in background else name for name in truth.class_names)
        known = TrueLabels(names, truth.frame)
        return Scene(frames, se3.inverse(T[0]) @ T, known, Vocabulary())


# --- detections -----------------------------------------------------------------------------------
def detected(scene: Scene, model: str) -> list[RegionDetections]:
    network = open_detector(model, NetworkConfig())
    index = np.array([scene.vocabulary.index(name) for name in network.labels])
    found = [network.detect(frame.color) for frame in scene.frames]
    return [
        RegionDetections.of_detector(f.boxes_px, index[f.class_ids], f.scores.astype(np.float32))
        for f in found
    ]


def true_boxes(scene: Scene) -> list[RegionDetections]:
    labels = coco_list(scene.truth.class_names)
    table = labels.of_truth(scene.truth.class_names)
    frames = map(scene.truth.frame, range(len(scene.frames)))
    return [_boxes_of(frame, table[frame.class_ids], labels.names, scene) for frame in frames]


def _boxes_of(
    frame: FrameLabels, truth: np.ndarray, names: tuple[str, ...], s: Scene
) -> RegionDetections:
    boxes, labels = [], []
    for instance in np.flatnonzero(np.bincount(frame.instance_ids.ravel()) >= _least(truth)):
        mask = frame.instance_ids == instance
        label = int(np.bincount(truth[mask]).argmax())
        if label not in (0, VOID):
            v, u = np.nonzero(mask)
            boxes.append([u.min() - 0.5, v.min() - 0.5, u.max() + 0.5, v.max() + 0.5])
            labels.append(s.vocabulary.index(names[label]))
    ones = np.ones(len(boxes), np.float32)
    return RegionDetections.of_detector(np.reshape(boxes, (-1, 4)), np.array(labels, int), ones)


def _least(image: np.ndarray) -> float:
    return MIN_SHARE * image.size


def with_label_results(
    scene: Scene, region_detections: list[RegionDetections], reliability: float
) -> list[RegionDetections]:
    """Return the detections with the oracle's labels where the detector is uncertain."""
    rng, names = np.random.default_rng(0), scene.truth.class_names
    usable = [k for k, name in enumerate(names) if not is_void(name)]
    out = []
    for k, (detections, frame) in enumerate(zip(region_detections, scene.frames, strict=True)):
        shown = scene.truth.frame(k).class_ids
        labels, sure = detections.labels.copy(), np.zeros(len(detections.boxes), np.float32)
        found = surfaces(frame.depth_m, frame.camera, ForegroundConfig())
        for i in np.flatnonzero(detections.confidences < RegionProposalConfig().sure):
            mask = region(detections.boxes[i], frame, found)
            true = np.bincount(shown[mask], minlength=len(names))[usable]
            right, wrong = usable[int(true.argmax())], usable[rng.integers(len(usable))]
            is_right = rng.random() < reliability
            labels[i] = scene.vocabulary.index(names[right if is_right else wrong])
            sure[i] = reliability
        out.append(replace(detections, open_labels=labels, open_confidences=sure))
    return out


def region(box: np.ndarray, frame: RgbdFrame, found: SmoothSurfaces) -> np.ndarray:
    """Return the mask [H, W] of the foreground in a box, or of the whole box if it has none."""
    part = foreground(box, frame.depth_m, found, frame.camera, ForegroundConfig())
    mask = part.image(frame.depth_m.shape)
    if not mask.any():
        mask[pixels_of(box, mask.shape)] = True
    return mask


# --- runs -----------------------------------------------------------------------------------------
def variants() -> dict[str, SemanticFusionConfig]:
    out = {}
    for area in ("foreground", "box"):
        for rule in ("coverage", "iou"):
            for ema in ("corrected", "paper"):
                labels = LabelConfig(ema=ema, hold_back=0.0 if ema == "paper" else 1.0)
                out[f"{area} {rule} {ema}"] = SemanticFusionConfig(
                    region=area, assignment=AssignmentConfig(rule), labels=labels
                )
    return out


class LabelRun:
    """Labels of a map that follow added and removed Gaussians."""

    def __init__(
        self,
        name: str,
        what: str,
        region_detections: list[RegionDetections],
        config: SemanticFusionConfig,
    ) -> None:
        self.name, self.what, self.region_detections, self.config = (
            name,
            what,
            region_detections,
            config,
        )
        self.labels, self._ids = new_labels(0), np.zeros(0, np.int64)

    def follow(self, ids: np.ndarray) -> None:
        labels, (_, new, old) = new_labels(len(ids)), np.intersect1d(ids, self._ids, True, True)
        labels[new] = self.labels[old]
        self.labels, self._ids = labels, ids.copy()

    @property
    def is_summed(self) -> bool:
        """True if the sum over all Gaussians of a pixel is evaluated too, which takes longer."""
        return self.what == DEFAULT


def label_runs(
    scene: Scene,
    region_detections: dict[str, list[RegionDetections]],
    only: str,
    reliability: float | None,
) -> Iterator[LabelRun]:
    for name, detections in region_detections.items():
        for what, config in variants().items():
            if only in what and (name != TRUE_BOXES or "coverage corrected" in what):
                yield LabelRun(name, what, detections, config)
        if reliability is not None and name != TRUE_BOXES:
            answered = with_label_results(scene, detections, reliability)
            calls = np.mean([np.any(c.open_confidences > 0) for c in answered])
            print(f"{name}: the oracle labels regions on {calls:.0%} of the frames")
            for rule in ("fixed", "adaptive"):
                config = SemanticFusionConfig(fusion=FusionConfig(rule=rule))
                yield LabelRun(name, f"{DEFAULT}, {rule} fusion", answered, config)


def grown(scene: Scene, runs: list[LabelRun], iterations: int) -> MapBuilder:
    builder = MapBuilder()
    for k in range(0, len(scene.frames), 2):
        frame, T = scene.frames[k], scene.T_map_camera[k]
        builder.add(frame, T, k, iterations)
        shown = builder.render_from(frame.camera, T, contributions=True)
        assert shown.contributions is not None
        indices, gaussians = shown.contributions.indices, builder.gaussians
        for run in runs:
            run.follow(gaussians.ids)
            view = frame.camera, T, frame.depth_m, run.region_detections[k]
            fuse_detections(gaussians.rows, run.labels, indices, *view, run.config)
    return builder


def painted(region_detections: RegionDetections, frame: RgbdFrame, area: str) -> np.ndarray:
    """Return the label image of one frame's regions, the most confident on top."""
    image, config = np.zeros(frame.depth_m.shape, np.uint8), ForegroundConfig()
    found = surfaces(frame.depth_m, frame.camera, config) if area == "foreground" else None
    for box, label in zip(
        region_detections.boxes[::-1], region_detections.labels[::-1], strict=True
    ):
        if found is None:
            image[pixels_of(box, image.shape)] = label
        else:
            part = foreground(box, frame.depth_m, found, frame.camera, config)
            image[part.image(image.shape)] = label
    return image


# --- report ---------------------------------------------------------------------------------------
class Report:
    def __init__(self, scene: Scene, pictures: Path | None) -> None:
        self._scene, self._pictures = scene, pictures
        print("| detections | rule | mIoU | all names | consistency | beyond COCO | labelled |")
        print("|---|---|---|---|---|---|---|")

    def line(self, name: str, what: str, image: Callable[[int], np.ndarray], share: str) -> None:
        errors = self._errors(image)
        coco, full = (
            " (".join(f"{100 * row.figures(gate).mean_iou:.1f}" for gate in GATES.values()) + ")"
            for row in errors.lists
        )
        beyond = "".join(
            f"{100 * found.recall:.0f} % of {found.wanted}, {100 * found.precision:.0f} % right"
            for found in (errors.objects,)
            if found.named
        )
        agreed = f"{errors.consistency.share:.3f}"
        print(f"| {name} | {what} | {coco} | {full} | {agreed} | {beyond} | {share} |", flush=True)

    def _errors(self, image: Callable[[int], np.ndarray]) -> LabelErrors:
        scene, images = self._scene, {}
        evaluate = LabelEvaluator(scene.vocabulary.names, scene.truth.class_names)
        for k, frame in enumerate(scene.frames):
            images[k] = image(k)
            evaluate.see(LabelView(frame, scene.truth.frame(k), images[k]))
            if (first := k - APART) in images:
                evaluate.compare(images.pop(first), images[k], scene.pairs[first])
        return evaluate.errors("")

    def show(self, name: str, image: Callable[[int], np.ndarray]) -> None:
        if self._pictures is None:
            return
        self._pictures.mkdir(parents=True, exist_ok=True)
        scene, views = self._scene, []
        for k in (np.linspace(0.05, 0.95, 6) * len(scene.frames)).astype(int).tolist():
            view = LabelView(scene.frames[k], scene.truth.frame(k), image(k))
            views.append(LabelPicture(f"frame {k}", view))
        sheet = label_sheet(views, scene.vocabulary.names, scene.truth.class_names)
        cv2.imwrite(str(self._pictures / f"{name.replace(' ', '_')}.jpg"), sheet[..., ::-1])


def top_image(labels: np.ndarray, shown: Rendering) -> np.ndarray:
    """Return per pixel the most likely label of the Gaussian with the largest contribution.

    The image is uint8 [H, W]; pixels without a Gaussian are background.
    """
    assert shown.contributions is not None
    top = shown.contributions.top
    return np.where(top >= 0, top_labels(labels)[top], BACKGROUND).astype(np.uint8)


def evaluate_all(scene: Scene, runs: list[LabelRun], builder: MapBuilder, report: Report) -> None:
    frames, T = scene.frames, scene.T_map_camera
    shown: list[Rendering] = [
        builder.render_from(frame.camera, T[k], contributions=True)
        for k, frame in enumerate(frames)
    ]
    rows = builder.gaussians.rows
    for run in sorted(runs, key=lambda run: run.what != DEFAULT):
        share = f"{100 * np.mean(top_labels(run.labels) > 0):.3f} %"
        report.line(run.name, run.what, lambda k, r=run: top_image(r.labels, shown[k]), share)

        def summed(k: int, run: LabelRun = run) -> np.ndarray:
            view = frames[k].camera, se3.inverse(T[k])
            return label_image(rows, run.labels, shown[k], *view, threads=2)

        if run.is_summed:
            report.line(run.name, f"{run.what}, sum of w p", summed, share)
        if run.what == DEFAULT:
            report.show(run.name, summed)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("source", nargs="?", default="synthetic:flat")
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--only", default="", help="only rules with this text in their name")
    parser.add_argument("--fusion", type=float, metavar="P")
    parser.add_argument("--background", nargs="+", default=(), metavar="NAME")
    parser.add_argument("--detectors", nargs="+", default=(), metavar="MODEL")
    parser.add_argument(
        "--painted", action="store_true", help="only paint single frames, without a map"
    )
    parser.add_argument("--max-frames", type=int)
    parser.add_argument("--iterations", type=int, default=6)
    arguments = parser.parse_args()
    models = {name: name for name in arguments.detectors} or {
        name: str(Path(os.environ["LDO_WEIGHTS"]) / file) for name, file in NETWORKS.items()
    }
    scene = Scene.of(arguments.source, arguments.max_frames, arguments.background)
    region_detections = {name: detected(scene, model) for name, model in models.items()}
    region_detections[TRUE_BOXES] = true_boxes(scene)
    report = Report(scene, arguments.pictures)
    for name, detections in region_detections.items():
        for area in ("foreground", "box"):
            report.line(
                name,
                f"{area} painted",
                lambda k, s=detections, a=area: painted(s[k], scene.frames[k], a),
                "",
            )
    if arguments.painted:
        return
    runs = list(label_runs(scene, region_detections, arguments.only, arguments.fusion))
    builder = grown(scene, runs, arguments.iterations)
    print(f"{len(scene.frames)} frames, {len(builder.gaussians)} Gaussians in the map")
    evaluate_all(scene, runs, builder, report)


if __name__ == "__main__":
    main()
