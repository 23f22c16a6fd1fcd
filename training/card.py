"""Model card of the built-in networks: description, scores and limits."""

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
SURE = 0.5  # Minimum confidence of the predictions that are also counted separately.
LARGE_SHARE = 0.01  # Minimum size of large crops: visible object pixels, fraction of the image.


def naming_report(naming: Naming, is_large: np.ndarray) -> dict:
    """Return the scores of the predicted names of N crops; `_totals` explains the keys.

    Args:
        naming: Predicted names of the crops.
        is_large: Mask [N] of the large crops, which also get separate scores.
    """
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
    """Return the scores of the predicted names of regions; `_of_regions` explains the keys.

    For a region without an object, each name that means "no object" (NO_THINGS) is correct.
    """
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
    """Return the model card in Markdown.

    Args:
        report: The scores, as in scores.json.
        folder: Folder of the networks' files, whose sizes the card lists.
    """
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
    """Return a list of names as wrapped lines of a Markdown list item."""
    return "\n  ".join(textwrap.wrap(", ".join(names), 98))


def _totals(report: dict) -> str:
    rows = {
        "frames": "frames",
        "mAP50": "detector: mAP50",
    }
    named = {
        "crops": "crops of ground-truth boxes",
        "top1": "correct names: all crops",
        "top1_coco": "correct names: classes of COCO",
        "top1_others": "correct names: other classes",
        "top1_building": "correct names: wall, floor, ceiling",
        "large": f"large crops ({LARGE_SHARE:.0%} of the image or more)",
        "large_coco": "correct names: large crops, classes of COCO",
        "large_others": "correct names: large crops, other classes",
        "sure_share": f"crops with a confidence of {SURE:g} or more",
        "sure_top1": "correct names: crops with this confidence",
        "calibration_error": "expected calibration error of the names",
    }
    sets = report["held_out"], report["flat"]
    lines = [_row(label, *(one[key] for one in sets)) for key, label in rows.items()]
    lines += [_row(label, *(one["encoder"][key] for one in sets)) for key, label in named.items()]
    return "\n".join(lines)


def _of_regions(regions: dict) -> str:
    rows = {
        "regions": "regions",
        "things": "regions with an object or a part of one",
        "things_right": "with object: correct name",
        "things_sure_right": f"with object: correct name, confidence of {SURE:g} or more",
        "things_sure_wrong": f"with object: wrong name, confidence of {SURE:g} or more",
        "no_things_unnamed": "without object: recognized as such",
        "no_things_sure": f"without object: name of an object, confidence of {SURE:g} or more",
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

These are small networks for the synthetic scenes of this package. With them, `ldo demo` detects
and names objects without a download. They do not work on real images. For real images, register a
detector trained on COCO (`ldo models add`) and an image-text model.

{note}| file | size |
|---|---|
{files}

License: Apache-2.0, like the rest of the package. `python training/train_demo.py` writes the files
and this card.

## What they are
- `detector.onnx` has the input and output of YOLOv8. Input: `images` [1, 3, 256, 320], RGB in 0..1,
  the image in the center and padding of gray 114. Output: `output0` [1, 4 + C, 1680]. A proposal
  network predicts boxes from the whole image. A copy of the image encoder rescores the best 64
  boxes; all other boxes have score 0. The C classes are the classes of COCO that occur in the
  synthetic scenes; the file's metadata has their names:
  {coco}.
- `image_encoder.onnx` has the input and output of CLIP. Input: `pixel_values` [N, 3, 64, 64], RGB
  normalized with CLIP's mean and standard deviation. Each crop shows the box of a region and a
  margin of 0.15 of the box's width and height. The crop keeps its aspect ratio and is centered in a
  square of CLIP's mean color. Output: `image_embeds` [N, D], unit vectors. Each vector is the
  normalized sum of the vectors of the crop and of its mirror image.
- `text_embeddings.npz` has `names` [T], unit vectors `embeddings` [T, D] and `logit_scale` (also in
  the encoder's metadata). Confidences are softmax(logit_scale * image . text) over all T names,
  calibrated for the regions that a labeller receives. The names are those of the detector;
  {others};
  and {building} and background, which all mean that there is no object.

There is no text encoder, so the labeller can choose only from the names in `text_embeddings.npz`
and their synonyms. If the service runs with a shorter list of names, `ldo control add-label` can
add more of these names. It rejects any other name.

## Training data
The networks are trained on renderings of random furnished rooms, 320x240 pixels, with random
exposure, tint, motion blur and noise. The rooms have the catalog of objects, the paints and the
lens of the sequence `synthetic:flat` (the flat), but other sizes, layouts and seeds. The flat is
used only for the scores below. The flat has the same catalog as the rooms. Its scores are thus for
known shapes in new arrangements and paints, not for new shapes.

The encoder is trained in two rounds. The first round uses crops of objects. In the second round,
half of the crops show regions as the service proposes them. A third of these regions show no
object, and a third show a part of an object.

Rendering took {rendering} minutes of CPU time. Training took {training} minutes of CPU time for
{detector} steps of the detector's proposal network and {encoder} steps of the encoder. The
seed is {seed}.

## Scores
These are scores of the shipped files. `rooms` are held-out rooms; `flat` is every 8th frame of
`synthetic:flat`. For the detector, objects smaller than 0.1 % of the image are not counted, nor are
the boxes that match them. The crops show all objects that cover at least 0.04 % of the image and an
eighth of their box. In the rooms, some crops show a bare wall, floor or ceiling.

| | rooms | flat |
|---|---|---|
{totals}

Scores of naming the regions that `regions/geometric_segmentation.py` proposes in the held-out
rooms:

| | rooms |
|---|---|
{regions}

Detector by class: number of objects, average precision at IoU 0.5, and recall and precision of
boxes with a score of at least 0.25.

| | rooms: objects | AP50 | recall | precision | flat: objects | AP50 | recall | precision |
|---|---|---|---|---|---|---|---|---|
{detected}

Each row gives the fraction of the crops of one name that the encoder names correctly. The encoder
chooses from all names.

| | rooms | flat |
|---|---|---|
{named}

## Limits
- Large objects in partial view (the corner of a bed, a couch's side, a table under other objects)
  often get a wrong box or name. So do cabinets, suitcases, and shelves from the side. The scores
  above count every view of an object. In good views, names are correct far more often.
- In the synthetic scenes, apples, oranges, sports balls and mice are all balls of any color. Only
  their size and surroundings differ, and a crop does not show the size. A door is a bare board,
  which can be mistaken for a wall.
- Objects of a few pixels (mouse, remote, cell phone, fruit) are mostly missed.
- Scores of the detector are not probabilities: more than 60 % of the boxes with a score of 0.6 or
  more are correct. Confidences of the names are calibrated for regions of similar rooms and for the
  full list of names. They are not meaningful for other images.
- Training is deliberately short: with more steps both networks still improve.
"""
