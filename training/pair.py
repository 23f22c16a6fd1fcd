"""The two training rounds of the dual encoder: first on objects, then on objects and regions.

The service requests names for region proposals. The module `regions` computes the same proposals
for training. A third of the regions show no object, and a third show a part of an object. In the
second round, half of the crops in each batch therefore show regions. Regions without an object get
the additional name NO_NAME.
"""

from collections.abc import Callable, Iterator, Sequence
from itertools import islice

import encoder
import jax.numpy as jnp
import numpy as np
from crops import INPUT_PX, crop, enlarged
from encoder import BATCH, DIMENSIONS, NAMES, RATE, Framing, Pair
from layers import JaxNetwork
from regions import NO_THING
from views import Views, VisibleBoxes

import training
from ldo_service.regions.region_views import ViewConfig
from ldo_service.synthetic.flat.scene_object import BUILDING, CLASS_NAMES

NO_NAME = "background"  # Name of a region that shows no object.
NO_THINGS = (*BUILDING.split(), NO_NAME)
# Sides of the crops in pixels, each with its fraction of the steps, for each round. Small
# crops come first, because a step with small crops takes a fraction of the time (Tan and Le,
# EfficientNetV2, ICML 2021).
SIDES = ((32, 0.3), (48, 0.7)), ((48, 0.5), (INPUT_PX, 0.5))
# Variation of the crops of regions. Nothing is cut off, because many regions are already cut off.
ABOUT_REGIONS = Framing((0.1, 0.2), 0.04, 0.0)
# Fraction of crops of regions in a batch, and fraction of these regions that show no object.
REGIONS_SHARE, NO_THING_SHARE = 0.5, 0.35
MARGIN = ViewConfig().context  # Margin of a labeller's crop, as a fraction of the region's sides.


def train(material: Views, steps: Sequence[int], seed: int) -> Pair:
    """Train the dual encoder.

    Args:
        material: Training frames.
        steps: Number of training steps of each of the two rounds.
        seed: Seed of weights and batches.
    """
    rng = np.random.default_rng([seed, 2])
    live = JaxNetwork({}, rng=rng)
    encoder.network(live, jnp.zeros((1, INPUT_PX, INPUT_PX, 3)))
    texts = rng.standard_normal((len(NAMES), DIMENSIONS)).astype(np.float32)
    weights = live.weights | {"texts.kernel": texts}
    first, second = (share * RATE for share in training.ROUND_RATES)
    # First round: objects.
    things = growing(lambda side_px: encoder.batches(material, rng, side_px), SIDES[0], steps[0])
    weights = training.fit(encoder.loss, weights, things, steps[0], first)
    # Second round: objects and regions.
    weights |= {"texts.kernel": _with_no_name(weights["texts.kernel"])}
    rng = np.random.default_rng([seed, 7])
    both = growing(lambda side_px: batches(material, rng, side_px), SIDES[1], steps[1])
    weights = training.fit(encoder.loss, weights, both, steps[1], second)
    texts = np.asarray(encoder.unit(jnp.asarray(weights.pop("texts.kernel"))))
    again = batches(material, np.random.default_rng([seed, 5]))
    inputs = (np.asarray(encoder.normalized(crops)) for crops, _ in again)
    statistics = training.statistics(encoder.network, weights, inputs)
    return Pair(weights, statistics, texts, (*NAMES, NO_NAME))


def _with_no_name(texts: np.ndarray) -> np.ndarray:
    """Add a vector for NO_NAME to the table [T, D]: the mean of wall, floor and ceiling."""
    building = [NAMES.index(name) for name in BUILDING.split()]
    return np.concatenate([texts, texts[building].mean(axis=0, keepdims=True)])


def growing(
    source: Callable[[int], Iterator[tuple]], sides: Sequence[tuple[int, float]], steps: int
) -> Iterator[tuple]:
    """Yield batches whose crops become larger during the round.

    Args:
        source: Function that returns endless batches of crops with a given side in pixels.
        sides: Sides of the crops in pixels, each with its fraction of the steps.
        steps: Number of steps of the round.
    """
    for side_px, share in sides[:-1]:
        yield from islice(source(side_px), round(share * steps))
    yield from source(sides[-1][0])


def batches(material: Views, rng: np.random.Generator, side_px: int = INPUT_PX) -> Iterator[tuple]:
    """Yield batches like `encoder.batches`, but half of the crops show regions."""
    regions, names = named(material.regions)
    odds, count = _odds(names), round(REGIONS_SHARE * BATCH)
    for crops, told in encoder.batches(material, rng, side_px, BATCH - count):
        rows = rng.choice(len(names), count, p=odds)
        shown = [
            encoder.shown_in(material, regions, row, side_px, rng, ABOUT_REGIONS) for row in rows
        ]
        others = np.array([encoder.example(one, None, side_px, rng) for one in shown])
        yield np.concatenate((crops, others)), np.concatenate((told, names[rows]))


def named(regions: VisibleBoxes) -> tuple[VisibleBoxes, np.ndarray]:
    """Return the regions that have a name in NAMES or show no object, and their name indices.

    The indices refer to (*NAMES, NO_NAME).
    """
    own = {CLASS_NAMES.index(name): k for k, name in enumerate(NAMES)} | {NO_THING: len(NAMES)}
    chosen = regions.chosen(np.array([k in own for k in regions.class_ids.tolist()], bool))
    return chosen, np.array([own[k] for k in chosen.class_ids.tolist()], np.int64)


def crops_of(regions: VisibleBoxes, colors: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return crops of regions as a labeller receives them, and the indices of their names.

    Args:
        regions: Regions of the frames.
        colors: Frames [H, W, 3] uint8 RGB.

    Returns:
        Crops [N, 64, 64, 3] uint8, and the indices [N] of their names in (*NAMES, NO_NAME).
    """
    regions, names = named(regions)
    rows = zip(regions.frames, regions.boxes_px, strict=True)
    return np.array([crop(colors[f], enlarged(box, MARGIN)) for f, box in rows]), names


def is_right(names: np.ndarray) -> np.ndarray:
    """Return the mask [N, T + 1] of the correct names of each region.

    The columns are the T names in NAMES, then NO_NAME. For a region without an object, all names in
    NO_THINGS are correct.

    Args:
        names: True name of each region, [N], as an index in (*NAMES, NO_NAME).
    """
    among = (*NAMES, NO_NAME)
    right = np.arange(len(among)) == names[:, None]
    right[names == len(NAMES)] = np.isin(among, NO_THINGS)
    return right


def _odds(names: np.ndarray) -> np.ndarray:
    """Return the sampling probabilities [N] of regions.

    The frequency of a name is proportional to the square root of its number of regions. Regions
    without an object together have the probability NO_THING_SHARE.
    """
    odds, is_thing = 1 / np.sqrt(np.bincount(names)[names]), names < len(NAMES)
    odds[is_thing] *= (1 - NO_THING_SHARE) / odds[is_thing].sum()
    odds[~is_thing] *= NO_THING_SHARE / odds[~is_thing].sum()
    return odds
