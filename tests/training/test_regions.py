"""Region proposals for training the labeller's encoder, as the service makes them."""

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
    """Return a wall at 3 m with boards before it: class, instance, left, top, right, bottom."""
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


def test_region_has_class_box_and_size_of_its_object(trainer: SimpleNamespace) -> None:
    (row,) = rows(trainer, (OVEN, 4, 100, 60, 180, 160))
    assert row[:2] == (OVEN, 4)
    np.testing.assert_allclose(row[2:6], (100, 60, 180, 160), atol=4)
    assert row[6] == pytest.approx(80 * 100, rel=0.1)


def test_region_of_several_objects_has_no_class(trainer: SimpleNamespace) -> None:
    """Boards that touch form one region. It has a class if one board covers 0.7 of the region."""
    small, large = (CHAIR, 2, 160, 60, 180, 160), (CHAIR, 2, 140, 60, 180, 160)
    (row,) = rows(trainer, (OVEN, 4, 100, 60, 160, 160), small)
    assert row[0] == OVEN
    (row,) = rows(trainer, (OVEN, 4, 100, 60, 140, 160), large)
    assert row[:2] == (trainer.regions.NO_THING, 0)


def test_small_piece_of_an_object_is_excluded(trainer: SimpleNamespace) -> None:
    """A pillar hides the oven except for two pieces."""
    pieces = (OVEN, 4, 20, 60, 60, 100), (OVEN, 4, 120, 40, 300, 230)
    (row,) = rows(trainer, *pieces)
    assert row[6] > 0.5 * 180 * 190
    (larger, smaller) = rows(trainer, (OVEN, 4, 20, 60, 100, 140), pieces[1])
    assert larger[:2] == smaller[:2] == (OVEN, 4)


def test_regions_are_named_by_class_or_as_background(trainer: SimpleNamespace) -> None:
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


def test_classes_without_an_object_equal_those_of_the_service(trainer: SimpleNamespace) -> None:
    assert set(trainer.pair.NO_THINGS) == set(NOTHING)


def test_regions_without_an_object_have_the_configured_frequency(trainer: SimpleNamespace) -> None:
    pair, none = trainer.pair, len(trainer.encoder.NAMES)
    names = np.array([none] * 50 + [1] * 9 + [3])
    odds = pair._odds(names)
    assert odds[names == none].sum() == pytest.approx(pair.NO_THING_SHARE)
    assert odds.sum() == pytest.approx(1)
    assert odds[names == 1].sum() == pytest.approx(3 * odds[names == 3].sum())


def test_half_of_a_batch_is_regions(trainer: SimpleNamespace) -> None:
    """A red frame has two ovens. A green frame has two regions: a chair, and one without object."""
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
    crops, labels = next(source)
    oven, chair, none = (
        encoder.NAMES.index("oven"),
        encoder.NAMES.index("chair"),
        len(encoder.NAMES),
    )
    assert set(labels.tolist()) == {oven, chair, none}
    is_region = labels != oven
    assert (is_region.sum(), len(labels)) == (encoder.BATCH // 2, encoder.BATCH)
    # The channels of some crops are swapped.
    is_green = crops[:, 24:40, 24:40].astype(float).mean(axis=(1, 2)).argmax(axis=1) == 1
    assert np.mean(is_green[is_region]) > 0.6 > 0.4 > np.mean(is_green[~is_region])


def test_fitted_scale_is_that_of_the_generated_names(trainer: SimpleNamespace) -> None:
    """Names are drawn with the softmax of a known scale; either of two right names may be drawn."""
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
