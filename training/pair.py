"""The dual encoder's two rounds: on things, then on things and regions.

A service asks about what geometry and colour set apart (`regions`): a third of that is no thing,
and a third a part of one. So in the second round half of each batch are crops of such regions, and
there is one name more, for what is no thing.
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

NO_NAME = "background"  # of a region that is no thing
NO_THINGS = (*BUILDING.split(), NO_NAME)
# Sides of crops in pixels, and shares of a round's steps: small ones first, of which a minute has
# several times as many (Tan and Le, EfficientNetV2, ICML 2021)
SIDES = ((32, 0.3), (48, 0.7)), ((48, 0.5), (INPUT_PX, 0.5))
ABOUT_REGIONS = Framing((0.1, 0.2), 0.04, 0.0)  # many are cut off as they are
REGIONS_SHARE, NO_THING_SHARE = 0.5, 0.35  # of a batch, and of these
MARGIN = ViewConfig().context  # of a region's sides, that a labeller's crop has around it


def train(material: Views, steps: Sequence[int], seed: int) -> Pair:
    """In rounds of so many steps, each with its share of the rate: see `training.fit_in_rounds`."""
    rng = np.random.default_rng([seed, 2])
    live = JaxNetwork({}, rng=rng)
    encoder.network(live, jnp.zeros((1, INPUT_PX, INPUT_PX, 3)))
    texts = rng.standard_normal((len(NAMES), DIMENSIONS)).astype(np.float32)
    weights = live.weights | {"texts.kernel": texts}
    first, second = (share * RATE for share in training.ROUND_RATES)
    # things
    things = growing(lambda side_px: encoder.batches(material, rng, side_px), SIDES[0], steps[0])
    weights = training.fit(encoder.loss, weights, things, steps[0], first)
    # and regions
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
    """[T + 1, D]: it begins between wall, floor and ceiling."""
    building = [NAMES.index(name) for name in BUILDING.split()]
    return np.concatenate([texts, texts[building].mean(axis=0, keepdims=True)])


def growing(
    source: Callable[[int], Iterator[tuple]], sides: Sequence[tuple[int, float]], steps: int
) -> Iterator[tuple]:
    """Batches of `source(side_px)` for so many steps, `sides` as in SIDES."""
    for side_px, share in sides[:-1]:
        yield from islice(source(side_px), round(share * steps))
    yield from source(sides[-1][0])


def batches(material: Views, rng: np.random.Generator, side_px: int = INPUT_PX) -> Iterator[tuple]:
    """As those of `encoder`, with regions in place of a half."""
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
    """Regions that have a name, and its index: after NAMES comes NO_NAME."""
    own = {CLASS_NAMES.index(name): k for k, name in enumerate(NAMES)} | {NO_THING: len(NAMES)}
    chosen = regions.chosen(np.array([k in own for k in regions.class_ids.tolist()], bool))
    return chosen, np.array([own[k] for k in chosen.class_ids.tolist()], np.int64)


def crops_of(regions: VisibleBoxes, colors: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Crops of regions as a labeller sees them, and their names' indices."""
    regions, names = named(regions)
    rows = zip(regions.frames, regions.boxes_px, strict=True)
    return np.array([crop(colors[f], enlarged(box, MARGIN)) for f, box in rows]), names


def is_right(names: np.ndarray) -> np.ndarray:
    """[N, T + 1] bool, what regions with these names [N] may be called: any of NO_THINGS where they
    are none."""
    among = (*NAMES, NO_NAME)
    right = np.arange(len(among)) == names[:, None]
    right[names == len(NAMES)] = np.isin(among, NO_THINGS)
    return right


def _odds(names: np.ndarray) -> np.ndarray:
    """[N] of regions: each name as often as the root of its number, and none as is set."""
    odds, is_thing = 1 / np.sqrt(np.bincount(names)[names]), names < len(NAMES)
    odds[is_thing] *= (1 - NO_THING_SHARE) / odds[is_thing].sum()
    odds[~is_thing] *= NO_THING_SHARE / odds[~is_thing].sum()
    return odds
