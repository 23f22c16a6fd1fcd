"""Scores of the exported networks.

The networks run in onnxruntime and use no training code.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import cells
import cv2
import encoder
import numpy as np
import onnxruntime
from crops import planes
from views import VisibleBoxes

import examples
from ldo_service.synthetic.flat.scene_object import CLASS_NAMES

# Minimum score of the evaluated boxes, and maximum IoU between two of them.
SCORE_MIN, NMS_IOU = 0.01, 0.45
HIT_IOU = 0.5  # Minimum IoU of a correct box.
SHARE_MIN = 1e-3  # Minimum size of an object that the scores count, as a fraction of the image.
FRAME_PX = (320, 240)  # Width and height.
TOP_PX = (cells.INPUT_PX[1] - FRAME_PX[1]) // 2  # First row of the frame in the input.


@dataclass(frozen=True, slots=True)
class Found:
    """Detections in one frame of size FRAME_PX."""

    boxes_px: np.ndarray  # Boxes [M, 4], x0, y0, x1, y1.
    scores: np.ndarray  # Scores [M].
    class_ids: np.ndarray  # Indices [M] into `cells.NAMES`.


@dataclass(frozen=True, slots=True)
class ClassScore:
    """Scores of one class over all frames."""

    objects: int  # Number of ground-truth objects.
    average_precision: float  # Average precision over all points, at IoU 0.5.
    recall: float  # Recall of the boxes with a score of at least `at`, see `detection`.
    precision: float  # Precision of the same boxes.


def session(path: Path) -> onnxruntime.InferenceSession:
    """Return a single-threaded CPU session of an ONNX file."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])


def canvas(color: np.ndarray) -> np.ndarray:
    """Return the detector's input [256, 320, 3] for a 4:3 frame [H, W, 3] uint8 RGB."""
    whole = np.full((*cells.INPUT_PX[::-1], 3), examples.PADDING, np.uint8)
    whole[TOP_PX : TOP_PX + FRAME_PX[1]] = cv2.resize(color, FRAME_PX)
    return whole


def output(network: onnxruntime.InferenceSession, image: np.ndarray) -> np.ndarray:
    """Run the detector on its input [256, 320, 3] uint8.

    Returns:
        Array [N, 4 + C] with a row for each cell: cx, cy, w, h of its box in pixels, then the
        scores of the C classes.
    """
    values = image.transpose(2, 0, 1)[None].astype(np.float32) / 255
    return np.asarray(network.run(None, {"images": values})[0])[0].T


def find(network: onnxruntime.InferenceSession, color: np.ndarray) -> Found:
    """Return the detections in a 4:3 frame [H, W, 3] uint8 RGB."""
    rows = output(network, canvas(color))
    class_ids, scores = rows[:, 4:].argmax(axis=1), rows[:, 4:].max(axis=1)
    corners = np.hstack((rows[:, :2] - rows[:, 2:4] / 2, rows[:, 2:4]))
    ids = class_ids.astype(np.int32)
    kept = cv2.dnn.NMSBoxesBatched(corners, scores, ids, SCORE_MIN, NMS_IOU)  # type: ignore[arg-type]
    kept = np.array(kept, np.int64)
    boxes = np.hstack((corners[:, :2], corners[:, :2] + corners[:, 2:]))[kept] - [
        0,
        TOP_PX,
        0,
        TOP_PX,
    ]
    return Found(np.clip(boxes, 0, [*FRAME_PX] * 2), scores[kept], class_ids[kept])


def detection(
    found: Iterable[Found], seen: VisibleBoxes, at: float = 0.25
) -> dict[str, ClassScore]:
    """Return the scores of each class that occurs, by name.

    Objects smaller than the fraction SHARE_MIN of the image are not counted. Boxes that match these
    objects are not counted either.

    Args:
        found: Detections of each frame.
        seen: Ground-truth boxes in pixels of FRAME_PX.
        at: Minimum score of boxes for recall and precision.
    """
    frames = list(found)
    truth = of_coco(seen)
    return {
        name: _class_score(frames, truth.chosen(truth.class_ids == k), k, at)
        for k, name in enumerate(cells.NAMES)
        if np.any((truth.class_ids == k) & _counts(truth))
    }


def mean_average_precision(scores: dict[str, ClassScore]) -> float:
    """Return the mean average precision over all classes."""
    return float(np.mean([score.average_precision for score in scores.values()]))


def of_coco(seen: VisibleBoxes) -> VisibleBoxes:
    """Return the objects of the detector's classes, with the detector's class ids."""
    own = {CLASS_NAMES.index(name): k for k, name in enumerate(cells.NAMES)}
    chosen = seen.chosen(np.array([k in own for k in seen.class_ids.tolist()]))
    return replace(chosen, class_ids=np.array([own[k] for k in chosen.class_ids.tolist()]))


def _counts(truth: VisibleBoxes) -> np.ndarray:
    return truth.pixels >= SHARE_MIN * FRAME_PX[0] * FRAME_PX[1]


def _class_score(frames: list[Found], truth: VisibleBoxes, class_id: int, at: float) -> ClassScore:
    """Return the scores of one class.

    Boxes are matched with objects in order of descending score. Each box is matched with the
    unmatched object that it overlaps most, if their IoU is at least HIT_IOU.
    """
    counts = _counts(truth)
    rows = []  # Pairs of score and 1 for a correct box, 0 otherwise.
    for number, frame in enumerate(frames):
        mine = np.flatnonzero(frame.class_ids == class_id)
        mine = mine[np.argsort(-frame.scores[mine], kind="stable")]
        free = list(np.flatnonzero(truth.frames == number))
        for row in mine:
            overlaps = _iou(frame.boxes_px[row], truth.boxes_px[free]) if free else np.zeros(1)
            best = int(overlaps.argmax())
            if overlaps[best] < HIT_IOU:
                rows.append((frame.scores[row], 0))
            elif counts[free.pop(best)]:
                rows.append((frame.scores[row], 1))
    table = np.array(sorted(rows, key=lambda r: -r[0])).reshape(-1, 2)
    objects = int(counts.sum())
    hits, confident = np.cumsum(table[:, 1]), table[:, 0] >= at
    recall, precision = hits / objects, hits / np.arange(1, len(table) + 1)
    envelope = np.maximum.accumulate(precision[::-1])[::-1]
    area = float(np.sum(np.diff(recall, prepend=0.0) * envelope))
    told, right = int(confident.sum()), int(table[confident, 1].sum())
    return ClassScore(objects, area, right / objects, right / told if told else 1.0)


def _iou(box: np.ndarray, others: np.ndarray) -> np.ndarray:
    low, high = np.maximum(box[:2], others[:, :2]), np.minimum(box[2:], others[:, 2:])
    common = np.maximum(high - low, 0).prod(axis=1)
    areas = (others[:, 2:] - others[:, :2]).prod(axis=1)
    return common / ((box[2:] - box[:2]).prod() + areas - common)


@dataclass(frozen=True, slots=True)
class Naming:
    """Predicted names of N crops."""

    truth: np.ndarray  # Ground-truth indices [N] into the encoder's names.
    told: np.ndarray  # Predicted indices [N] into the encoder's names.
    confidence: np.ndarray  # Softmax probabilities [N] of the predicted names.

    def accuracy(self, names: Iterable[str] = encoder.NAMES) -> float:
        """Return the fraction of correct predictions among crops whose true name is in `names`."""
        mine = np.isin(self.truth, [encoder.NAMES.index(name) for name in names])
        return float(np.mean(self.told[mine] == self.truth[mine])) if mine.any() else float("nan")

    def calibration_error(self, bins: int = 10) -> float:
        """Return the expected calibration error (Guo et al., ICML 2017)."""
        place = np.minimum((self.confidence * bins).astype(int), bins - 1)
        right = self.told == self.truth
        gaps = [
            abs(np.mean(right[place == k]) - np.mean(self.confidence[place == k]))
            * np.mean(place == k)
            for k in range(bins)
            if np.any(place == k)
        ]
        return float(np.sum(gaps))


def embedded(network: onnxruntime.InferenceSession, crops: np.ndarray) -> np.ndarray:
    """Run the image encoder on crops [N, 64, 64, 3] uint8, and return their vectors [N, D]."""
    return np.asarray(network.run(None, {"pixel_values": planes(crops)})[0])


def naming(folder: Path, crops: np.ndarray, truth: np.ndarray) -> Naming:
    """Predict the names of crops with the image encoder and the text embeddings in a folder.

    Args:
        folder: Folder with image_encoder.onnx and text_embeddings.npz.
        crops: Crops [N, 64, 64, 3] uint8.
        truth: Ground-truth indices [N] into the encoder's names.
    """
    with np.load(folder / "text_embeddings.npz") as texts:
        vectors, scale = texts["embeddings"], float(texts["logit_scale"])
    cosines = embedded(session(folder / "image_encoder.onnx"), crops) @ vectors.T
    logits = np.exp(scale * (cosines - cosines.max(axis=1, keepdims=True)))
    softmax = logits / logits.sum(axis=1, keepdims=True)
    return Naming(truth, softmax.argmax(axis=1), softmax.max(axis=1))
