"""Small dual encoder with CLIP's inputs and outputs: vectors of crops and names in one space.

Input:
    pixel_values: RGB [N, 3, 64, 64], normalized with CLIP's mean and standard deviation. Each crop
        is centered in a square of CLIP's mean color.

Output:
    image_embeds: Unit vectors [N, 96].

There is no text encoder. The vectors of the names are a table, which `pair` trains together with
the image encoder.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from crops import DEVIATION, INPUT_PX, MARGIN, MEAN, crop, cut, enlarged, framed, resized
from layers import Graph, JaxNetwork, Statistics, Weights, merged, residual
from views import Views, VisibleBoxes
from wear import degrade, recolor

from ldo_service.synthetic.flat.catalog import CATALOG
from ldo_service.synthetic.flat.scene_object import BUILDING, CLASS_NAMES

DIMENSIONS = 96
NAMES = tuple(name for name in CLASS_NAMES if name in CATALOG or name in BUILDING.split())

# Minimum side of a box for training, and minimum fraction of the box that the object fills.
SIDE_MIN_PX, FILLED_MIN = 6, 0.12
CUT_MOST = 0.5  # Maximum fraction of a box that is cut off at one side.
# Fraction of the crops with an occluder, and the occluder's size as a fraction of the crop's side.
OCCLUDED_SHARE, OCCLUDER = 0.3, (0.3, 0.7)
BLUR_PX = 0.06  # Maximum blur as a fraction of the crop's longer side.

BATCH, RATE = 32, 1e-2
SCALE = 16.0  # Scale of the cosines in training; the exported scale is fitted afterwards.
SMOOTHING = 0.05  # Label smoothing over all names.


@dataclass(frozen=True, slots=True)
class Framing:
    """Parameters of the random margin, offset and cut of the crop around a box."""

    margins: tuple[float, float]  # Range of the margin, as a fraction of the box's sides.
    jitter: float  # Maximum offset of each side, as a fraction of the box's sides.
    cut_share: float  # Fraction of the crops that lack a part of one side.


ABOUT_THINGS = Framing((0.0, 0.25), 0.08, 0.3)


def network(net: JaxNetwork | Graph, image) -> list:
    """Compute the vectors of images, before normalization to unit length.

    Args:
        net: Backend of the network, see `layers`.
        image: Normalized crops [N, H, W, 3].

    Returns:
        Vectors [N, 1, 1, D] with D = DIMENSIONS.
    """
    x = residual(net, merged(net, image, "stem", 64, side=4), "stage4", 64)
    x = net.conv(x, "down8", 128, stride=2)
    for k in range(2):
        x = residual(net, x, f"stage8.{k}", 128)
    x = net.conv(x, "down16", 192, stride=2)
    for k in range(2):
        x = residual(net, x, f"stage16.{k}", 192)
    return net.linear(net.mean(x), "embed", DIMENSIONS)


@dataclass(frozen=True, slots=True)
class Pair:
    """Trained dual encoder: an image encoder and a table with a vector for each name."""

    weights: Weights
    statistics: Statistics  # Means and variances of the normalized layers.
    texts: np.ndarray  # Unit vector of each name [T, D].
    names: tuple[str, ...]  # The T names.

    def images(self, crops: np.ndarray, with_mirror: bool = True) -> np.ndarray:
        """Return unit vectors [N, D] of crops [N, 64, 64, 3] uint8.

        If `with_mirror` is true, the vectors of a crop and of its mirror image are added, and the
        sum is scaled to unit length.
        """
        live = JaxNetwork(self.weights, self.statistics)
        sides = (crops, crops[:, :, ::-1])[: 1 + with_mirror]
        return np.asarray(unit(sum(network(live, normalized(side))[:, 0, 0] for side in sides)))


def unit(x):
    """Scale vectors to unit length."""
    return x / jnp.sqrt((x * x).sum(-1, keepdims=True) + 1e-12)


def normalized(crops):
    """Normalize crops [N, H, W, 3] uint8 with CLIP's mean and deviation."""
    return (jnp.asarray(crops, jnp.float32) / 255 - MEAN) / DEVIATION


def loss(weights: Weights, batch: tuple):
    """Calculate the cross entropy of the names with label smoothing.

    Args:
        weights: Weights of the network and the table of names.
        batch: Crops [N, 64, 64, 3] uint8 and the indices [N] of their names.
    """
    crops, names = batch
    images = unit(network(JaxNetwork(weights), normalized(crops))[:, 0, 0])
    logits = SCALE * images @ unit(weights["texts.kernel"]).T
    told = jax.nn.log_softmax(logits)
    right = jnp.take_along_axis(told, names[:, None], 1)[:, 0]
    return -((1 - SMOOTHING) * right + SMOOTHING * told.mean(-1)).mean()


def learnable(seen: VisibleBoxes) -> tuple[VisibleBoxes, np.ndarray]:
    """Return the boxes that show enough of their object, and the indices of their names in NAMES.

    A box must have sides of at least SIDE_MIN_PX, and its object must fill at least the fraction
    FILLED_MIN of the box.
    """
    sides = seen.boxes_px[:, 2:] - seen.boxes_px[:, :2]
    chosen = seen.chosen(
        (sides.min(axis=1) >= SIDE_MIN_PX) & (seen.pixels >= FILLED_MIN * sides.prod(axis=1))
    )
    own = {CLASS_NAMES.index(name): k for k, name in enumerate(NAMES)}
    return chosen, np.array([own[k] for k in chosen.class_ids.tolist()], np.int64)


def batches(
    material: Views, rng: np.random.Generator, side_px: int = INPUT_PX, size: int = BATCH
) -> Iterator[tuple]:
    """Yield batches of augmented crops around ground-truth boxes, without end.

    The frequency of a name is proportional to the square root of its number of boxes.

    Args:
        material: Training frames.
        rng: Source of the random choice of boxes and of the augmentation.
        side_px: Side of the crops.
        size: Number of crops in a batch.

    Yields:
        Crops [size, side_px, side_px, 3] and the indices [size] of their names.
    """
    seen, names = learnable(material.seen)
    counts = np.bincount(names, minlength=len(NAMES))
    odds = 1 / np.sqrt(counts[names])
    odds /= odds.sum()
    while True:
        rows, others = rng.choice(len(names), (2, size), p=odds)
        shown = [shown_in(material, seen, row, side_px, rng, ABOUT_THINGS) for row in rows]
        before = [
            shown_in(
                material, seen, row, round(rng.uniform(*OCCLUDER) * side_px), rng, ABOUT_THINGS
            )
            if rng.random() < OCCLUDED_SHARE
            else None
            for row in others
        ]
        crops = [example(*pair, side_px, rng) for pair in zip(shown, before, strict=True)]
        yield np.array(crops), names[rows]


@dataclass(frozen=True, slots=True)
class Shown:
    """Crop of a frame around one object, or around a region."""

    color: np.ndarray  # RGB [h, w, 3].
    plane: np.ndarray  # Instance ids [h, w].
    instance: int  # Instance id of the object; 0 without an object.


def shown_in(
    material: Views,
    seen: VisibleBoxes,
    row: int,
    side_px: int,
    rng: np.random.Generator,
    framing: Framing,
) -> Shown:
    """Cut one box out of its frame, with a random margin and offset.

    Sometimes a part of the box at one of its four sides is cut off.

    Args:
        material: Training frames.
        seen: Boxes of the frames.
        row: Index of the box.
        side_px: Longer side of the result.
        rng: Source of the variation.
        framing: Bounds of the variation.
    """
    box_px = seen.boxes_px[row]
    sides = box_px[2:] - box_px[:2]
    off = rng.uniform(-framing.jitter, framing.jitter, 4) * np.tile(sides, 2)
    box_px = enlarged(box_px, rng.uniform(*framing.margins)) + off
    if rng.random() < framing.cut_share:
        edge = int(rng.integers(4))
        box_px[edge] += (1 if edge < 2 else -1) * rng.uniform(0, CUT_MOST) * sides[edge % 2]
    color, plane = (part[seen.frames[row]] for part in (material.colors, material.instances))
    return Shown(
        resized(cut(color, box_px), side_px),
        resized(cut(plane, box_px), side_px, is_ids=True),
        int(seen.instances[row]),
    )


def example(
    shown: Shown, before: Shown | None, side_px: int, rng: np.random.Generator
) -> np.ndarray:
    """Return an augmented crop of an object.

    Args:
        shown: Crop of the object.
        before: Crop of another object, which is pasted in front of it; None for no occlusion.
        side_px: Side of the returned crop, pixels.
        rng: Random number generator.
    """
    color = recolor(shown.color, shown.plane, rng)
    if before is not None:
        _cover(color, before, rng)
    taken = framed(degrade(color, rng, BLUR_PX * side_px), side_px)
    return taken[:, ::-1] if rng.random() < 0.5 else taken


def _cover(color: np.ndarray, by: Shown, rng: np.random.Generator) -> None:
    """Paste the object of the crop `by` at a random position of an image [h, w, 3], in place."""
    place = rng.integers(0, np.array(color.shape[:2])) - np.array(by.plane.shape) // 2
    low = np.maximum(place, 0)
    high = np.minimum(place + by.plane.shape, color.shape[:2])
    there = tuple(slice(*ends) for ends in zip(low, high, strict=True))
    own = tuple(slice(*ends) for ends in zip(low - place, high - place, strict=True))
    is_it = (by.plane[own] == by.instance) & (by.instance > 0)
    color[there][is_it] = by.color[own][is_it]


def crops_of(seen: VisibleBoxes, colors: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return crops of the visible objects of frames, and the indices of their names.

    Args:
        seen: Visible objects of the frames.
        colors: Frames [H, W, 3] uint8 RGB.

    Returns:
        Crops [N, 64, 64, 3] uint8 of the objects that are `learnable`, and the indices [N] of their
        names in NAMES.
    """
    seen, names = learnable(seen)
    rows = zip(seen.frames, seen.boxes_px, strict=True)
    return np.array([crop(colors[f], enlarged(box, MARGIN)) for f, box in rows]), names


def fitted_scale(images: np.ndarray, texts: np.ndarray, is_right: np.ndarray) -> float:
    """Return the scale of the cosines that minimizes the negative log-likelihood of the names.

    This is temperature scaling (Guo et al., ICML 2017).

    Args:
        images: Unit vectors [N, D] of images.
        texts: Unit vectors [T, D] of names.
        is_right: Mask [N, T] of the correct names; an image may have several.
    """
    scales = np.geomspace(2, 200, 200)
    cosines = images @ texts.T

    def surprise(scale: float) -> float:
        logits = scale * (cosines - cosines.max(axis=1, keepdims=True))
        powers = np.exp(logits)
        told = np.sum(powers * is_right, axis=1) / powers.sum(axis=1)
        return -float(np.log(np.maximum(told, 1e-12)).mean())

    return float(min(scales, key=surprise))


def embedded(graph: Graph, crops: str, output: str = "", with_mirror: bool = True) -> str:
    """Add the image encoder to an ONNX graph.

    Args:
        graph: Graph to which the nodes are added. It has the weights of the image encoder.
        crops: Name of the tensor of normalized crops [N, 3, H, W].
        output: Name of the resulting tensor; if empty, the graph chooses a name.
        with_mirror: If true, the vectors of a crop and of its mirror image are added, and the sum
            is scaled to unit length. If false, the mirror image is not used.

    Returns:
        Name of the tensor of unit vectors [N, D].
    """
    both = graph.node("Concat", crops, graph.mirrored(crops), axis=0) if with_mirror else crops
    raw = graph.node("Flatten", network(graph, both), axis=1)
    if with_mirror:
        raw = graph.add(*graph.halves(raw))
    return graph.node("LpNormalization", raw, output=output, axis=1, p=2)


def export(pair: Pair, scale: float, folder: Path) -> None:
    """Write image_encoder.onnx and text_embeddings.npz into a folder.

    Args:
        pair: Trained dual encoder.
        scale: Calibrated scale of the cosines (logit scale).
        folder: Folder for the files.
    """
    graph = Graph(pair.weights, pair.statistics)
    embedded(graph, "pixel_values", "image_embeds")
    about = {"logit_scale": repr(scale), "license": "Apache-2.0"}
    shapes = ("batch", 3, INPUT_PX, INPUT_PX), ("batch", DIMENSIONS)
    graph.save(
        folder / "image_encoder.onnx",
        ("pixel_values", shapes[0]),
        ("image_embeds", shapes[1]),
        about,
    )
    np.savez(
        folder / "text_embeddings.npz",
        names=np.array(pair.names),
        embeddings=pair.texts.astype(np.float32),
        logit_scale=np.float32(scale),
    )
