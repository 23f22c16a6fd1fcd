"""The model card: what the networks are, what they score, what they cannot do."""

import textwrap
from pathlib import Path

import cells
import encoder
import numpy as np
from pair import NO_NAME, NO_THINGS
from scores import Naming

from ldo_service.synthetic.flat.scene_object import BUILDING, CLASS_NAMES, COCO_COUNT

OTHERS = tuple(
    name for name in encoder.NAMES if name not in (*CLASS_NAMES[:COCO_COUNT], *BUILDING.split())
)
SURE = 0.5  # confidence that an answer is counted from, beside counting all
LARGE_SHARE = 0.01  # of the image, of crops that are counted apart


def naming_report(naming: Naming, is_large: np.ndarray) -> dict:
    """Accuracies of one set of crops; `is_large` [N] chooses those counted apart."""
    large = Naming(naming.truth[is_large], naming.told[is_large], naming.confidence[is_large])
    coco = [name for name in encoder.NAMES if name in CLASS_NAMES[:COCO_COUNT]]
    per_name = {name: naming.accuracy([name]) for name in encoder.NAMES}
    sure = naming.confidence >= SURE
    return {
        "crops": len(naming.truth),
        "top1": naming.accuracy(),
        "top1_coco": naming.accuracy(coco),
        "top1_others": naming.accuracy(OTHERS),
        "top1_building": naming.accuracy(BUILDING.split()),
        "large": len(large.truth),
        "large_coco": large.accuracy(coco),
        "large_others": large.accuracy(OTHERS),
        "sure_share": float(sure.mean()),
        "sure_top1": float((naming.told == naming.truth)[sure].mean()),
        "calibration_error": naming.calibration_error(),
        "per_name": {name: round(one, 3) for name, one in per_name.items() if one == one},
    }


def regions_report(naming: Naming) -> dict:
    """What is said of regions; those that show no thing are right with any name of no thing."""
    no_things = [k for k, name in enumerate((*encoder.NAMES, NO_NAME)) if name in NO_THINGS]
    is_thing, is_named = naming.truth < len(encoder.NAMES), ~np.isin(naming.told, no_things)
    is_right, is_sure = naming.told == naming.truth, is_named & (naming.confidence >= SURE)
    return {
        "regions": len(naming.truth),
        "things": float(is_thing.mean()),
        "things_right": float(is_right[is_thing].mean()),
        "things_sure_right": float((is_right & is_sure)[is_thing].mean()),
        "things_sure_wrong": float((~is_right & is_sure)[is_thing].mean()),
        "no_things_unnamed": float((~is_named)[~is_thing].mean()),
        "no_things_sure": float(is_sure[~is_thing].mean()),
    }


def written(report: dict, folder: Path) -> str:
    """The card in Markdown."""
    sizes = {
        file.name: file.stat().st_size
        for file in sorted(folder.glob("*.*"))
        if file.suffix in (".onnx", ".npz")
    }
    files = "\n".join(f"| `{name}` | {size / 1e6:.2f} MB |" for name, size in sizes.items())
    return TEXT.format(
        note=report.get("note", ""),
        files=files,
        coco=_filled(cells.NAMES),
        others=_filled(OTHERS),
        building=", ".join(BUILDING.split()),
        totals=_totals(report),
        regions=_of_regions(report["held_out"]["regions"]),
        detected=_detected(report),
        named=_named(report),
        **report["steps"],
        seed=report["seed"],
        **report["cpu_min"],
    )


def _filled(names: tuple[str, ...]) -> str:
    """A list of names in lines within an item."""
    return "\n  ".join(textwrap.wrap(", ".join(names), 98))


def _totals(report: dict) -> str:
    rows = {
        "frames": "frames",
        "mAP50": "detector: mAP50",
    }
    named = {
        "crops": "crops of true boxes",
        "top1": "names: top-1, all",
        "top1_coco": "names: top-1, COCO's",
        "top1_others": "names: top-1, others",
        "top1_building": "names: top-1, wall, floor, ceiling",
        "large": f"crops of {LARGE_SHARE:.0%} of the image or more",
        "large_coco": "names: top-1 of those, COCO's",
        "large_others": "names: top-1 of those, others",
        "sure_share": f"names: told with {SURE:g} or more, all",
        "sure_top1": "names: top-1 of those",
        "calibration_error": "names: calibration error",
    }
    sets = report["held_out"], report["flat"]
    lines = [_row(label, *(one[key] for one in sets)) for key, label in rows.items()]
    lines += [_row(label, *(one["encoder"][key] for one in sets)) for key, label in named.items()]
    return "\n".join(lines)


def _of_regions(regions: dict) -> str:
    rows = {
        "regions": "regions",
        "things": "of which a thing, or a part of one",
        "things_right": "things: named right",
        "things_sure_right": f"things: named right, with {SURE:g} or more",
        "things_sure_wrong": f"things: named wrong, with {SURE:g} or more",
        "no_things_unnamed": "no things: told to be none",
        "no_things_sure": f"no things: named with {SURE:g} or more",
    }
    return "\n".join(_row(label, regions[key]) for key, label in rows.items())


def _detected(report: dict) -> str:
    sets = [report[name]["detector"] for name in ("held_out", "flat")]
    columns = ("objects", "average_precision", "recall", "precision")
    return "\n".join(
        _row(name, *(one.get(name, {}).get(column, "") for one in sets for column in columns))
        for name in cells.NAMES
    )


def _named(report: dict) -> str:
    sets = [report[name]["encoder"]["per_name"] for name in ("held_out", "flat")]
    return "\n".join(_row(name, *(one.get(name, "") for one in sets)) for name in encoder.NAMES)


def _row(name: str, *values: float | str) -> str:
    cells = (f"{value:.2f}" if isinstance(value, float) else str(value) for value in values)
    return f"| {name} | {' | '.join(cells)} |"


TEXT = """\
# The built-in demo networks

Small networks for the synthetic scenes of this package, so that `ldo demo` shows the whole
semantic path without a download. They know nothing of the real world: register a detector trained
on COCO (`ldo models add`) and an image-text model for that.

{note}| file | size |
|---|---|
{files}

Apache-2.0, like the rest. Written by `python training/train_demo.py`, which also wrote this card.

## What they are
- `detector.onnx`: the layout of YOLOv8. `images` [1, 3, 256, 320], RGB 0..1, the image centred on
  grey 114; `output0` [1, 4 + C, 1680]. A first look at the whole image proposes boxes; the best 64
  are looked at again by a copy of the image encoder, and have scores. Classes of COCO that the
  catalogue of the synthetic scenes has, named in its metadata:
  {coco}.
- `image_encoder.onnx`: the layout of CLIP. `pixel_values` [N, 3, 64, 64], RGB with CLIP's mean
  and deviation: a region's box and 0.15 of its sides around, in proportion, in the middle of a
  square of CLIP's mean. `image_embeds` [N, D] of length 1, of the crop and its mirror image. It has
  learned from regions as the service sets them apart, a third of them no thing, a third a part.
- `text_embeddings.npz`: `names` [T], `embeddings` [T, D] of length 1 and `logit_scale` (also in the
  encoder's metadata) of softmax(logit_scale * image . text) over all T names. It suits the regions
  that a labeller is asked about. The names: those of the detector;
  {others};
  and {building} and background, which say that there is no object.

There is no text encoder. A name of the table can be added to a shorter list while the service runs
(`ldo control add-label`), with its synonyms; any other name is refused.

## What they learned from
Renders at 320x240 of random furnished rooms with the flat's catalogue, pools of paints and lens,
but other sizes, layouts and seeds, made worse by exposure, tint, motion blur and noise. The flat
was used for the scores below and for nothing else; but since its catalogue is theirs, these
scores are those of known shapes in new arrangements and paints, not of new shapes.

Rendering took {rendering} minutes of CPU time, {detector} steps of the detector's first look and
{encoder} of the encoder {training}, the last half of these on regions too. Seed {seed}.

## Scores
Of the files as shipped. `rooms`: rooms kept apart; `flat`: every 8th frame of `synthetic:flat`.
Objects of less than 0.1 % of the image count neither way for the detector; crops are of all
objects of at least 0.04 % that fill an eighth of their box.

| | rooms | flat |
|---|---|---|
{totals}

Regions of the rooms kept apart, as `regions/geometric_segmentation.py` finds them:

| | rooms |
|---|---|
{regions}

Detector by class: objects, average precision at IoU 0.5, recall and precision of boxes with a
score of at least 0.25.

| | rooms: objects | AP50 | recall | precision | flat: objects | AP50 | recall | precision |
|---|---|---|---|---|---|---|---|---|
{detected}

Names of crops by true name: share named right, among all names.

| | rooms | flat |
|---|---|---|
{named}

## Limits
- Large things seen in part (the corner of a bed, a couch's side, a table under what lies on it) are
  often boxed or named wrong; so are a cabinet and a suitcase, and a shelf from the side. Where a
  thing is seen well, from its best views, names are far better than the table says, which counts
  every view.
- An apple, an orange, a sports ball and a mouse are a ball each here, in any colour: what tells
  them apart is size, which a crop does not show, and what lies about them. A door is a bare board,
  and can be taken for wall.
- Things of a few pixels (mouse, remote, cell phone, fruit) are mostly missed.
- Scores of the detector are not probabilities: sure boxes (0.6 or more) are right more often than
  that. Confidences of the names suit regions of rooms of the same kind, over the whole table, and
  mean nothing for pictures of anything else.
- Training is short, by intent: with more steps both networks still improve.
"""
