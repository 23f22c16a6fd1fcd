"""What the labeller's encoder learns from: regions as the service sets them apart."""

import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from ldo_service.demo_networks import NOTHING
from ldo_service.synthetic.flat import CLASS_NAMES
from ldo_service.synthetic.flat.render import FlatRendering

pytest.importorskip("jax", reason="needs the trainer's libraries: pip install --group train")

OVEN, CHAIR, WALL = (CLASS_NAMES.index(name) for name in ("oven", "chair", "wall"))


@pytest.fixture
def trainer(monkeypatch: pytest.MonkeyPatch) -> Iterator[SimpleNamespace]:
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "training")
    import encoder
    import pair
    import regions
    import views

    yield SimpleNamespace(encoder=encoder, pair=pair, regions=regions, views=views)
    for name in ("encoder", "pair", "crops", "layers", "regions", "training", "wear"):
        sys.modules.pop(name, None)
    for name in ("views", "layout"):
        sys.modules.pop(name, None)


def frame(*things: tuple[int, int, int, int, int, int]) -> FlatRendering:
    """A wall at 3 m, and boards before it: class, instance, left, top, right, bottom."""
    light, depth_m = np.full((240, 320, 3), 0.5), np.full((240, 320), 3.0)
    class_ids, instance_ids = np.full((240, 320), WALL), np.zeros((240, 320), np.uint16)
    for class_id, instance, left, top, right, bottom in things:
        at = np.s_[top:bottom, left:right]
        light[at], depth_m[at], class_ids[at], instance_ids[at] = 0.7, 2.0, class_id, instance
    return FlatRendering(light, depth_m, class_ids, instance_ids)


def rows(trainer: SimpleNamespace, *things) -> list[tuple]:
    found = trainer.regions.regions(
        frame(*things), trainer.views.camera(), np.random.default_rng(0)
    )
    return list(found)


def test_a_region_is_the_thing_that_it_shows(trainer: SimpleNamespace) -> None:
    (row,) = rows(trainer, (OVEN, 4, 100, 60, 180, 160))
    assert row[:2] == (OVEN, 4)
    np.testing.assert_allclose(row[2:6], (100, 60, 180, 160), atol=4)
    assert row[6] == pytest.approx(80 * 100, rel=0.1)


def test_a_region_of_several_things_is_none(trainer: SimpleNamespace) -> None:
    """Boards that touch hang together: 0.7 of both has to be one of them."""
    small, large = (CHAIR, 2, 160, 60, 180, 160), (CHAIR, 2, 140, 60, 180, 160)
    (row,) = rows(trainer, (OVEN, 4, 100, 60, 160, 160), small)
    assert row[0] == OVEN
    (row,) = rows(trainer, (OVEN, 4, 100, 60, 140, 160), large)
    assert row[:2] == (trainer.regions.NO_THING, 0)


def test_a_small_piece_of_a_thing_is_left_out(trainer: SimpleNamespace) -> None:
    """An oven of which a pillar hides all but two pieces."""
    pieces = (OVEN, 4, 20, 60, 60, 100), (OVEN, 4, 120, 40, 300, 230)
    (row,) = rows(trainer, *pieces)
    assert row[6] > 0.5 * 180 * 190
    (larger, smaller) = rows(trainer, (OVEN, 4, 20, 60, 100, 140), pieces[1])
    assert larger[:2] == smaller[:2] == (OVEN, 4)


def test_names_of_regions(trainer: SimpleNamespace) -> None:
    encoder, pair = trainer.encoder, trainer.pair
    unknown = CLASS_NAMES.index("person")
    ids = np.array([OVEN, trainer.regions.NO_THING, unknown, CHAIR])
    seen = trainer.views.VisibleBoxes(
        np.arange(4), ids, np.arange(4), np.tile([0.0, 0, 20, 20], (4, 1)), np.full(4, 400.0)
    )
    chosen, names = pair.named(seen)
    assert chosen.frames.tolist() == [0, 1, 3]
    assert names.tolist() == [
        encoder.NAMES.index("oven"),
        len(encoder.NAMES),
        encoder.NAMES.index("chair"),
    ]
    right = pair.is_right(names)
    among = np.array([*encoder.NAMES, pair.NO_NAME])
    assert [set(among[row]) for row in right] == [
        {"oven"},
        {"wall", "floor", "ceiling", "background"},
        {"chair"},
    ]


def test_what_is_told_by_nothing_is_what_was_learned_to_be_none(trainer: SimpleNamespace) -> None:
    assert set(trainer.pair.NO_THINGS) == set(NOTHING)


def test_no_things_are_as_often_as_is_set(trainer: SimpleNamespace) -> None:
    pair, none = trainer.pair, len(trainer.encoder.NAMES)
    names = np.array([none] * 50 + [1] * 9 + [3])
    odds = pair._odds(names)
    assert odds[names == none].sum() == pytest.approx(pair.NO_THING_SHARE)
    assert odds.sum() == pytest.approx(1)
    assert odds[names == 1].sum() == pytest.approx(3 * odds[names == 3].sum())


def test_half_of_a_batch_are_regions(trainer: SimpleNamespace) -> None:
    """Ovens are in a red frame; regions, a chair and nothing, in a green one."""
    encoder, views = trainer.encoder, trainer.views
    colors = np.zeros((2, 240, 320, 3), np.uint8)
    colors[0, ..., 0], colors[1, ..., 1] = 200, 200
    first, box, pixels = np.zeros(2, np.int64), np.array([[40.0, 40, 90, 90]] * 2), [2500.0] * 2
    things = views.VisibleBoxes(first, np.array([OVEN, OVEN]), first, box, np.array(pixels))
    ids = np.array([trainer.regions.NO_THING, CHAIR])
    regions = views.VisibleBoxes(first + 1, ids, first, box, np.array(pixels))
    instances = np.zeros((2, 240, 320), np.uint8)
    source = trainer.pair.batches(
        views.Views(colors, instances, things, regions), np.random.default_rng(0)
    )
    crops, told = next(source)
    oven, chair, none = (
        encoder.NAMES.index("oven"),
        encoder.NAMES.index("chair"),
        len(encoder.NAMES),
    )
    assert set(told.tolist()) == {oven, chair, none}
    is_region = told != oven
    assert (is_region.sum(), len(told)) == (encoder.BATCH // 2, encoder.BATCH)
    # channels are swapped in some
    is_green = crops[:, 24:40, 24:40].astype(float).mean(axis=(1, 2)).argmax(axis=1) == 1
    assert np.mean(is_green[is_region]) > 0.6 > 0.4 > np.mean(is_green[~is_region])


def test_the_scale_is_found_that_made_the_answers(trainer: SimpleNamespace) -> None:
    """Names drawn with the softmax of a known scale; where two names are right, either may be
    drawn."""
    rng = np.random.default_rng(0)
    texts = np.linalg.qr(rng.standard_normal((8, 8)))[0]
    images = rng.standard_normal((4000, 8))
    images /= np.linalg.norm(images, axis=1, keepdims=True)
    powers = np.exp(9 * images @ texts.T)
    odds = powers / powers.sum(axis=1, keepdims=True)
    drawn = np.array([rng.choice(8, p=row) for row in odds])
    is_right = drawn[:, None] == np.arange(8)
    is_right[drawn < 2, :2] = True
    assert trainer.encoder.fitted_scale(images, texts, is_right) == pytest.approx(9, rel=0.1)
