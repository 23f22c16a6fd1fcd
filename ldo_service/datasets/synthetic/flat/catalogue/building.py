"""Doors, windows and fixtures."""

from ldo_service.datasets.synthetic.flat.paint import Paints

from .build import Builder, Solids, ball, box, cylinder, solid


def door(paint: Paints, _: int) -> Solids:
    """A leaf standing open; the hinge is at the origin, the leaf along -y."""
    wood = paint("wood")
    knob = ball((0.045, -0.78, 1.0), (0.06, 0.06, 0.06), paint("metal"))
    return box((0, -0.425, 0.01), (0.04, 0.85, 2.02), wood), knob


def window(paint: Paints, _: int) -> Solids:
    """To hang up: two panes, a frame, a sill; the origin is the middle of its back."""
    frame = paint("wood")
    bars = [box((x, -0.025, -0.55), (0.06, 0.05, 1.1), frame) for x in (-0.62, 0.0, 0.62)]
    beams = [box((0, -0.025, z), (1.24, 0.05, 0.06), frame) for z in (-0.58, 0.52)]
    pane = box((0, -0.01, -0.55), (1.24, 0.02, 1.1), "ceiling")
    return pane, *bars, *beams, box((0, -0.07, -0.6), (1.34, 0.14, 0.03), frame)


def coat_rack(paint: Paints, _: int) -> Solids:
    wood = paint("wood")
    arms = [
        box((0, 0, z), (0.4, 0.025, 0.025), wood, turn)
        for z, turn in ((1.5, (1.0, 0.0)), (1.6, (0.0, 1.0)))
    ]
    coat = solid("lampshade", (0.16, 0, 0.7), (0.26, 0.3, 0.8), paint("fabric"))
    return (
        cylinder((0, 0, 0), 0.4, 0.03, wood),
        cylinder((0, 0, 0.03), 0.04, 1.68, wood),
        *arms,
        coat,
    )


BUILDERS: dict[str, Builder] = {"door": door, "window": window, "coat rack": coat_rack}
