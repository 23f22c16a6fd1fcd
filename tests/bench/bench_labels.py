"""How well the map's labels agree with the truth, by rule, beside painting each frame alone.

    LDO_WEIGHTS=... python tests/bench/bench_labels.py SOURCE [--only TEXT] [--pictures DIR]

SOURCE: a Replica folder with `semantic_class/`, `instance/`, `labels.json` and true poses. Every
second frame is a keyframe, where it really was; labels are fused as the map grows and judged at the
end, on all frames. Truth `undefined` is left out; classes that COCO has by another name are in
SYNONYMS, all others are background. mIoU is over background and the classes that have 0.2 % of the
pixels, and over all. Consistency: of pixels labelled an object in either of two frames 3 apart, the
share that agrees when warped by true depth and pose.
"""

import argparse
import json
import os
from collections.abc import Callable, Iterable
from pathlib import Path

import cv2
import numpy as np
import onnxruntime

from ldo_service.gaussians.map_builder import MapBuilder
from ldo_service.geometry import RgbdFrame, se3
from ldo_service.recordings.sequence import open_source
from ldo_service.semantics.assignment import AssignmentConfig
from ldo_service.semantics.foreground import ForegroundConfig, foreground, pixels_of, surfaces
from ldo_service.semantics.label_images import label_image, top_image
from ldo_service.semantics.labelling import Claims, LabellingConfig, label_keyframe
from ldo_service.semantics.labels import LabelConfig, new_labels, top_labels

VOID, FIRST = 255, 2  # truth that does not count; the label of the first COCO class
SYNONYMS = {
    "bike": "bicycle",
    "computer-keyboard": "keyboard",
    "hair-dryer": "hair drier",
    "indoor-plant": "pottedplant",
    "monitor": "tvmonitor",
    "phone": "cell phone",
    "remote-control": "remote",
    "table": "diningtable",
    "tv-screen": "tvmonitor",
}
MIN_SCORE, MAX_IOU, GATE, STEP = 0.25, 0.45, 0.002, 3
Detect = Callable[[np.ndarray], Claims]


# --- what is claimed ------------------------------------------------------------------------------
def best(boxes: np.ndarray, scores: np.ndarray) -> Claims:
    """Of centres and sizes [P, 4], px, and scores [P, 80]: those that suppress the others."""
    label, score = scores.argmax(axis=1), scores.max(axis=1)
    kept = score >= MIN_SCORE
    corners = np.concatenate([boxes[:, :2] - boxes[:, 2:] / 2, boxes[:, 2:]], axis=1)[kept]
    label, score = label[kept], score[kept]
    chosen = cv2.dnn.NMSBoxesBatched(corners.tolist(), score.tolist(), label.tolist(), 0, MAX_IOU)
    i = np.array(sorted(chosen, key=lambda k: -score[k]), int)
    corners[:, 2:] += corners[:, :2]
    return Claims.of_detector(corners[i], FIRST + label[i], score[i].astype(np.float32))


def letterboxed(
    image: np.ndarray, size: tuple[int, int], centred: bool
) -> tuple[np.ndarray, float, np.ndarray]:
    """The image in grey of (height, width); its scale; its first pixel."""
    scale = min(size[0] / image.shape[0], size[1] / image.shape[1])
    height, width = round(image.shape[0] * scale), round(image.shape[1] * scale)
    top, left = ((size[0] - height) // 2, (size[1] - width) // 2) if centred else (0, 0)
    out = np.full((*size, 3), 114, np.uint8)
    out[top : top + height, left : left + width] = cv2.resize(image, (width, height))
    return out, scale, np.array([left, top, 0, 0], np.float32)


def session(weights: Path) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(weights, options, providers=["CPUExecutionProvider"])


def yolox(weights: Path) -> Detect:
    network, cells = (
        session(weights),
        [
            np.stack(np.meshgrid(np.arange(416 // s), np.arange(416 // s)), -1).reshape(-1, 2)
            for s in (8, 16, 32)
        ],
    )
    grid = np.concatenate(cells)
    stride = np.repeat([8, 16, 32], [len(c) for c in cells])[:, None]

    def detect(rgb: np.ndarray) -> Claims:
        image, scale, _ = letterboxed(rgb[..., ::-1], (416, 416), centred=False)
        tensor = image.transpose(2, 0, 1)[None].astype(np.float32)
        out = np.asarray(network.run(None, {"images": tensor})[0])[0]
        boxes = np.hstack([(out[:, :2] + grid) * stride, np.exp(out[:, 2:4]) * stride]) / scale
        boxes[:, :2] += 0.5 / scale - 0.5
        return best(boxes, out[:, 4:5] * out[:, 5:])

    return detect


def yolov5(weights: Path) -> Detect:
    network = session(weights)

    def detect(rgb: np.ndarray) -> Claims:
        image, scale, start = letterboxed(rgb, (480, 640), centred=True)
        tensor = (image.transpose(2, 0, 1)[None] / 255).astype(np.float32)
        out = np.asarray(network.run(None, {"images": tensor})[0])[0]
        boxes = (out[:, :4] - start) / scale
        boxes[:, :2] += 0.5 / scale - 0.5
        return best(boxes, out[:, 4:5] * out[:, 5:])

    return detect


# --- what is true ---------------------------------------------------------------------------------
def read(path: Path) -> np.ndarray:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None, path
    return image


class Truth:
    def __init__(self, folder: Path, coco: list[str]) -> None:
        names = json.loads((folder / "labels.json").read_text())
        self._of_class = np.zeros(256, np.uint8)
        self._of_class[0] = VOID
        for number, name in names["classes"].items():
            name = SYNONYMS.get(str(name), str(name))
            if name in coco:
                self._of_class[int(number)] = FIRST + coco.index(name)
        self._class_of = {int(k): v["class_id"] for k, v in names["instances"].items()}
        self._semantic = sorted((folder / "semantic_class").glob("*.png"))
        self._instance = sorted((folder / "instance").glob("*.png"))

    def image(self, k: int) -> np.ndarray:
        return self._of_class[read(self._semantic[k])]

    def boxes(self, k: int) -> Claims:
        """Of objects that have 0.5 % of the pixels."""
        image = read(self._instance[k]).astype(int)
        boxes, labels = [], []
        for i in np.flatnonzero(np.bincount(image.ravel()) >= 0.005 * image.size):
            label = self._of_class[self._class_of.get(int(i), 0)]
            if label not in (0, VOID):
                v, u = np.nonzero(image == i)
                boxes.append([u.min() - 0.5, v.min() - 0.5, u.max() + 0.5, v.max() + 0.5])
                labels.append(label)
        ones = np.ones(len(boxes), np.float32)
        return Claims.of_detector(np.reshape(boxes, (-1, 4)), np.array(labels, int), ones)


def confusion(truth: Iterable[np.ndarray], images: Iterable[np.ndarray]) -> np.ndarray:
    """[256, 256] pixels of each label that are shown as each."""
    out = np.zeros((256, 256), np.int64)
    for a, b in zip(truth, images, strict=True):
        out += np.bincount(256 * a.ravel().astype(int) + b.ravel(), minlength=65536).reshape(
            256, -1
        )
    out[VOID] = 0
    return out


def mean_iou(counts: np.ndarray, gate: float) -> float:
    true, shown, right = counts.sum(axis=1), counts.sum(axis=0), np.diag(counts)
    judged = true > gate * true.sum()
    return 100 * float(np.mean(right[judged] / (true + shown - right)[judged]))


def consistency(images: list[np.ndarray], frames: list[RgbdFrame], T: np.ndarray) -> float:
    agree = total = 0
    for a, b in zip(range(len(images)), range(STEP, len(images)), strict=False):
        camera, depth_m = frames[a].camera, frames[a].depth_m
        p = se3.transform(se3.inverse(T[b]) @ T[a], camera.backproject(depth_m).reshape(-1, 3))
        i = np.flatnonzero((depth_m.ravel() > 0) & (p[:, 2] > 0.05))
        u, v = np.rint(camera.project(p[i])).astype(int).T
        inside = (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
        i, u, v = i[inside], u[inside], v[inside]
        same = np.abs(frames[b].depth_m[v, u] / p[i, 2] - 1) < 0.02
        first, second = images[a].ravel()[i[same]], images[b][v[same], u[same]]
        objects = (first > 0) | (second > 0)
        agree, total = agree + np.sum((first == second) & objects), total + np.sum(objects)
    return agree / max(total, 1)


# --- runs -----------------------------------------------------------------------------------------
def variants() -> dict[str, LabellingConfig]:
    out = {}
    for region in ("foreground", "box"):
        for rule in ("coverage", "iou"):
            for ema in ("corrected", "paper"):
                labels = LabelConfig(ema=ema, hold_back=0.0 if ema == "paper" else 1.0)
                out[f"{region} {rule} {ema}"] = LabellingConfig(
                    region=region, assignment=AssignmentConfig(rule), labels=labels
                )
    return out


class Follower:
    """Labels of a map that grows and loses Gaussians."""

    def __init__(self, config: LabellingConfig) -> None:
        self.config, self.labels, self._ids = config, new_labels(0), np.zeros(0, np.int64)

    def follow(self, ids: np.ndarray) -> None:
        labels, (_, new, old) = new_labels(len(ids)), np.intersect1d(ids, self._ids, True, True)
        labels[new] = self.labels[old]
        self.labels, self._ids = labels, ids.copy()


def painted(claims: Claims, frame: RgbdFrame, region: str) -> np.ndarray:
    """The regions of one frame, the surest on top."""
    image, config = np.zeros(frame.depth_m.shape, np.uint8), ForegroundConfig()
    found = surfaces(frame.depth_m, frame.camera, config)
    for box, label in zip(claims.boxes[::-1], claims.labels[::-1], strict=True):
        if region == "box":
            image[pixels_of(box, image.shape)] = label
        else:
            part = foreground(box, frame.depth_m, found, frame.camera, config)
            image[part.image(frame.depth_m.shape)] = label
    return image


def overlay(rgb: np.ndarray, labels: np.ndarray) -> np.ndarray:
    colors = np.random.default_rng(1).integers(60, 256, (256, 3))
    return np.where(labels[..., None] > 0, 0.4 * rgb + 0.6 * colors[labels], rgb)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("source", type=Path)
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--only", default="", help="rules whose name holds this")
    parser.add_argument("--max-frames", type=int)
    parser.add_argument("--iterations", type=int, default=6)
    arguments = parser.parse_args()
    weights = Path(os.environ["LDO_WEIGHTS"])
    coco = (weights / "coco_classes.txt").read_text().split("\n")[:80]
    truth, source = Truth(arguments.source, coco), open_source(str(arguments.source))
    frames = list(source)[: arguments.max_frames]
    known = source.truth()
    assert known is not None, "needs true poses"
    T = np.asarray(known.T_world_camera)[: len(frames)]
    T = se3.inverse(T[0]) @ T
    networks = {
        "YOLOX-Nano": yolox(weights / "yolox_nano.onnx"),
        "YOLOv5n": yolov5(weights / "yolov5n_480x640_w16.onnx"),
    }
    claims = {name: [net(f.color) for f in frames] for name, net in networks.items()}
    claims["true boxes"] = [truth.boxes(k) for k in range(len(frames))]
    runs = {
        (name, what): Follower(config)
        for name in claims
        for what, config in variants().items()
        if arguments.only in what and (name != "true boxes" or "coverage corrected" in what)
    }
    builder = MapBuilder()
    for k in range(0, len(frames), 2):
        frame = frames[k]
        builder.add(frame, T[k], k, arguments.iterations)
        shown = builder.seen_from(frame.camera, T[k], contributions=True)
        assert shown.contributions is not None
        indices, gaussians = shown.contributions.indices, builder.gaussians
        for (name, _), run in runs.items():
            run.follow(gaussians.ids)
            view = frame.camera, T[k], frame.depth_m, claims[name][k]
            label_keyframe(gaussians.rows, run.labels, indices, *view, run.config)
    report(builder, frames, T, truth, claims, runs, arguments.pictures)


def report(
    builder: MapBuilder,
    frames: list[RgbdFrame],
    T: np.ndarray,
    truth: Truth,
    claims: dict[str, list[Claims]],
    runs: dict[tuple[str, str], Follower],
    pictures: Path | None,
) -> None:
    true = [truth.image(k) for k in range(len(frames))]
    shown = [builder.seen_from(f.camera, T[k], contributions=True) for k, f in enumerate(frames)]
    print(f"{len(frames)} frames, {len(builder.gaussians)} Gaussians, {coco_share(true)}")
    print("| claims | rule | mIoU | all classes | consistency | labelled Gaussians |")
    print("|---|---|---|---|---|---|")

    def line(name: str, what: str, images: list[np.ndarray], share: str, judged: bool) -> None:
        counts = confusion(true, images)
        agreed = f"{consistency(images, frames, T):.3f}" if judged else ""
        both = f"{mean_iou(counts, GATE):.1f} | {mean_iou(counts, 0):.1f}"
        print(f"| {name} | {what} | {both} | {agreed} | {share} |", flush=True)

    for name in claims:
        for region in ("foreground", "box"):
            images = [painted(c, f, region) for c, f in zip(claims[name], frames, strict=True)]
            line(name, f"{region} painted", images, "", region == "foreground")
        for (whose, what), run in runs.items():
            if whose != name:
                continue
            share = f"{100 * np.mean(top_labels(run.labels) > 0):.3f} %"
            images = [top_image(run.labels, s) for s in shown]
            is_default = what == "foreground coverage corrected"
            line(name, what, images, share, is_default)
            if is_default:
                images = summed(builder, run, shown, frames, T)
                line(name, f"{what}, sum of w p", images, share, True)
                show(pictures, name, frames, images, true)


def summed(
    builder: MapBuilder, run: Follower, shown: list, frames: list[RgbdFrame], T: np.ndarray
) -> list[np.ndarray]:
    rows = builder.gaussians.rows
    return [
        label_image(rows, run.labels, shown[k], frame.camera, se3.inverse(T[k]))
        for k, frame in enumerate(frames)
    ]


def coco_share(true: list[np.ndarray]) -> str:
    counts = np.sum([np.bincount(image.ravel(), minlength=256) for image in true], 0)[:VOID]
    gated = np.flatnonzero(counts > GATE * counts.sum())
    return f"labels with 0.2 %: {gated.tolist()}"


def show(
    folder: Path | None,
    name: str,
    frames: list[RgbdFrame],
    images: list[np.ndarray],
    true: list[np.ndarray],
) -> None:
    if folder is None:
        return
    folder.mkdir(parents=True, exist_ok=True)
    chosen = np.linspace(0.05, 0.95, 6) * len(frames)
    rows = [
        np.hstack([overlay(frames[k].color, label % VOID) for label in (images[k], true[k])])
        for k in chosen.astype(int)
    ]
    path = folder / f"{name.replace(' ', '_')}.jpg"
    cv2.imwrite(str(path), np.vstack(rows).astype(np.uint8)[..., ::-1])


if __name__ == "__main__":
    main()
