"""A small dual encoder in the layout of CLIP: crops and names become vectors that can be compared.

in   pixel_values  [N, 3, 64, 64]   RGB with CLIP's mean and deviation; the crop in the middle of a
                                    square of that mean
out  image_embeds  [N, 96]          of length 1

The names' vectors are a table, learned together with the image encoder: there is no text encoder.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import training
from crops import DEVIATION, INPUT_PX, MARGIN, MEAN, crop, enlarged
from layers import Graph, Live, Statistics, Weights, residual
from material import worsened
from views import Seen, Views

from ldo_service.datasets.synthetic.flat.catalogue import CATALOGUE
from ldo_service.datasets.synthetic.flat.labels import BUILDING, CLASS_NAMES

DIMENSIONS = 96
NAMES = tuple(name for name in CLASS_NAMES if name in CATALOGUE or name in BUILDING.split())

MARGINS, JITTER = (0.0, 0.25), 0.08  # about a box, and how far each side may be off
SIDE_MIN_PX, FILLED_MIN = 6, 0.12  # of a box that is learned from, and its share that is the object
BLUR_PX = 0.06  # of the crop's longer side

BATCH, RATE = 32, 2e-3
SCALE = 16.0  # of cosines while training; what is told is fitted afterwards
SMOOTHING = 0.05  # of the right answer, over all names


def network(net: Live | Graph, image) -> list:
    """[N, 1, 1, D], before it is brought to length 1."""
    x = residual(net, net.conv(net.folded(image, 4), "stem", 64), "stage4", 64)
    x = net.conv(x, "down8", 128, stride=2)
    for k in range(2):
        x = residual(net, x, f"stage8.{k}", 128)
    x = net.conv(x, "down16", 144, stride=2)
    for k in range(2):
        x = residual(net, x, f"stage16.{k}", 144)
    return net.linear(net.mean(x), "embed", DIMENSIONS)


@dataclass(frozen=True, slots=True)
class Pair:
    """Both encoders: the image encoder's weights, and a vector for each of NAMES [T, D]."""

    weights: Weights
    statistics: Statistics
    texts: np.ndarray

    def images(self, crops: np.ndarray) -> np.ndarray:
        """Vectors [N, D] of crops [N, 64, 64, 3] uint8."""
        live = Live(self.weights, self.statistics)
        return np.asarray(unit(network(live, normalised(crops))[:, 0, 0]))


def unit(x):
    return x / jnp.sqrt((x * x).sum(-1, keepdims=True) + 1e-12)


def normalised(crops):
    return (jnp.asarray(crops, jnp.float32) / 255 - MEAN) / DEVIATION


def loss(weights: Weights, batch: tuple):
    """Cross entropy of the names, of crops [N, 64, 64, 3] uint8 and their names' indices [N]."""
    crops, names = batch
    images = unit(network(Live(weights), normalised(crops))[:, 0, 0])
    logits = SCALE * images @ unit(weights["texts.kernel"]).T
    told = jax.nn.log_softmax(logits)
    right = jnp.take_along_axis(told, names[:, None], 1)[:, 0]
    return -((1 - SMOOTHING) * right + SMOOTHING * told.mean(-1)).mean()


def learnable(seen: Seen) -> tuple[Seen, np.ndarray]:
    """The boxes that show enough of their object, and their indices into NAMES."""
    sides = seen.boxes_px[:, 2:] - seen.boxes_px[:, :2]
    chosen = seen.chosen(
        (sides.min(axis=1) >= SIDE_MIN_PX) & (seen.pixels >= FILLED_MIN * sides.prod(axis=1))
    )
    own = {CLASS_NAMES.index(name): k for k, name in enumerate(NAMES)}
    return chosen, np.array([own[k] for k in chosen.class_ids.tolist()], np.int64)


def batches(material: Views, rng: np.random.Generator) -> Iterator[tuple]:
    """Crops about true boxes, made worse; each name as often as the root of its number of boxes."""
    seen, names = learnable(material.seen)
    counts = np.bincount(names, minlength=len(NAMES))
    odds = 1 / np.sqrt(counts[names])
    odds /= odds.sum()
    while True:
        rows = rng.choice(len(names), BATCH, p=odds)
        crops = [
            _example(material.colors[seen.frames[row]], seen.boxes_px[row], rng) for row in rows
        ]
        yield np.array(crops), names[rows]


def _example(image: np.ndarray, box_px: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    sides = box_px[2:] - box_px[:2]
    off = rng.uniform(-JITTER, JITTER, 4) * np.tile(sides, 2)
    box_px = enlarged(box_px, rng.uniform(*MARGINS)) + off
    taken = crop(image, box_px, lambda part: worsened(part, rng, BLUR_PX * INPUT_PX))
    return taken[:, ::-1] if rng.random() < 0.5 else taken


def train(material: Views, steps: Sequence[int], seed: int) -> Pair:
    """In rounds of so many steps: `training.ROUND_RATES`."""
    rng = np.random.default_rng([seed, 2])
    live = Live({}, rng=rng)
    network(live, jnp.zeros((1, INPUT_PX, INPUT_PX, 3)))
    texts = rng.standard_normal((len(NAMES), DIMENSIONS)).astype(np.float32)
    start = live.weights | {"texts.kernel": texts}
    sources = rng, np.random.default_rng([seed, 7])
    weights = training.fit_in_rounds(
        loss, start, [batches(material, source) for source in sources], steps, RATE
    )
    rng = np.random.default_rng([seed, 5])
    inputs = (np.asarray(normalised(batch[0])) for batch in batches(material, rng))
    texts = np.asarray(unit(weights.pop("texts.kernel")))
    return Pair(weights, training.statistics(network, weights, inputs), texts)


def crops_of(seen: Seen, colors: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Crops of what frames show, and their names' indices."""
    seen, names = learnable(seen)
    rows = zip(seen.frames, seen.boxes_px, strict=True)
    return np.array([crop(colors[f], enlarged(box, MARGIN)) for f, box in rows]), names


def fitted_scale(images: np.ndarray, texts: np.ndarray, names: np.ndarray) -> float:
    """The scale of cosines whose softmax is least surprised by the truth: Guo et al., ICML 2017."""
    scales = np.geomspace(2, 200, 200)
    cosines = images @ texts.T

    def surprise(scale: float) -> float:
        logits = scale * (cosines - cosines.max(axis=1, keepdims=True))
        told = logits - np.log(np.exp(logits).sum(axis=1, keepdims=True))
        return -float(told[np.arange(len(names)), names].mean())

    return float(min(scales, key=surprise))


def embedded(graph: Graph, crops: str, output: str = "") -> str:
    """Vectors [N, D] of length 1, in a graph."""
    raw = graph.node("Flatten", network(graph, crops), axis=1)
    return graph.node("LpNormalization", raw, output=output, axis=1, p=2)


def export(pair: Pair, scale: float, folder: Path) -> None:
    """image_encoder.onnx and text_embeddings.npz."""
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
        names=np.array(NAMES),
        embeddings=pair.texts.astype(np.float32),
        logit_scale=np.float32(scale),
    )
