"""Builders of furniture, doors, windows and fixtures."""

from ldo_service.synthetic.flat.paint import Materials

from .build import Builder, Solids, ball, box, cylinder, legs, solid


def door(paint: Materials, _: int) -> Solids:
    """Build an open door with its hinge at the origin and its leaf along -y."""
    wood = paint("wood")
    knob = ball((0.045, -0.78, 1.0), (0.06, 0.06, 0.06), paint("metal"))
    return box((0, -0.425, 0.01), (0.04, 0.85, 2.02), wood), knob


def window(paint: Materials, _: int) -> Solids:
    """Build a window with two panes, a frame and a sill; the origin is the center of its back."""
    frame = paint("wood")
    bars = [box((x, -0.025, -0.55), (0.06, 0.05, 1.1), frame) for x in (-0.62, 0.0, 0.62)]
    beams = [box((0, -0.025, z), (1.24, 0.05, 0.06), frame) for z in (-0.58, 0.52)]
    pane = box((0, -0.01, -0.55), (1.24, 0.02, 1.1), "ceiling")
    return pane, *bars, *beams, box((0, -0.07, -0.6), (1.34, 0.14, 0.03), frame)


def coat_rack(paint: Materials, _: int) -> Solids:
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


FIXTURES: dict[str, Builder] = {"door": door, "window": window, "coat rack": coat_rack}


def chair(paint: Materials, shape: int) -> Solids:
    """Build a chair: shape 0 is a kitchen chair, 1 is a stool with a back, 2 is an office chair."""
    seat, frame = paint("fabric"), paint("wood")
    if shape == 0:
        posts = [box((x, 0.19, 0.47), (0.04, 0.04, 0.45), frame) for x in (-0.18, 0.18)]
        slats = [box((0, 0.19, z), (0.34, 0.03, 0.09), frame) for z in (0.6, 0.8)]
        top = box((0, 0, 0.42), (0.42, 0.42, 0.05), seat)
        return (*legs(0.42, 0.42, 0.42, 0.04, frame), top, *posts, *slats)
    if shape == 1:
        back = box((0, 0.2, 0.45), (0.46, 0.07, 0.42), seat)
        return (
            *legs(0.44, 0.44, 0.38, 0.05, frame),
            box((0, 0, 0.38), (0.46, 0.46, 0.09), seat),
            back,
        )
    metal = paint("metal")
    feet = (
        box((0, 0, 0.04), (0.56, 0.06, 0.04), metal),
        box((0, 0, 0.04), (0.06, 0.56, 0.04), metal),
    )
    column = cylinder((0, 0, 0.08), 0.06, 0.36, metal)
    top = cylinder((0, 0, 0.44), 0.48, 0.08, seat)
    spine = box((0, 0.23, 0.5), (0.06, 0.03, 0.2), metal)
    return (*feet, column, top, spine, box((0, 0.22, 0.64), (0.42, 0.06, 0.38), seat))


def couch(paint: Materials, shape: int) -> Solids:
    """Build a couch of two seats: shape 0 has arms, shape 1 is longer and has no arms."""
    cover, seat = paint("fabric"), paint("fabric")
    width = 1.5 if shape == 0 else 1.8
    body = box((0, 0, 0.08), (width, 0.8, 0.3), cover)
    back = box((0, 0.32, 0.38), (width, 0.18, 0.42), cover)
    pads = [box((x * width, -0.06, 0.38), (0.44 * width, 0.58, 0.1), seat) for x in (-0.23, 0.23)]
    if shape == 1:
        return body, back, *pads
    arms = [box((s * (width / 2 + 0.08), 0, 0.08), (0.16, 0.82, 0.5), cover) for s in (-1, 1)]
    return body, back, *pads, *arms


def bed(paint: Materials, _: int) -> Solids:
    frame, sheet, cover = paint("wood"), paint("fabric"), paint("print")
    return (
        box((0, 0, 0.12), (0.95, 1.95, 0.16), frame),
        box((0, 0, 0.28), (0.9, 1.9, 0.18), sheet),
        box((0, -0.3, 0.46), (0.94, 1.32, 0.05), cover),
        box((0, 0.72, 0.46), (0.6, 0.36, 0.1), paint("fabric")),
        box((0, 0.98, 0), (0.98, 0.05, 0.9), frame),
        *legs(0.9, 1.9, 0.12, 0.08, frame),
    )


def dining_table(paint: Materials, shape: int) -> Solids:
    """Build a table.

    Shape 0 stands on four legs, 1 is round and stands on a foot, 2 is a long desk on two panels.
    """
    top = paint("wood")
    if shape == 0:
        return (*legs(1.1, 0.66, 0.7, 0.06, top), box((0, 0, 0.7), (1.16, 0.72, 0.04), top))
    if shape == 1:
        foot = (cylinder((0, 0, 0), 0.5, 0.03, top), cylinder((0, 0, 0.03), 0.08, 0.68, top))
        return (*foot, cylinder((0, 0, 0.71), 0.9, 0.03, top))
    side = paint("plastic")
    sides = [box((s * 0.66, 0, 0), (0.04, 0.6, 0.71), side) for s in (-1, 1)]
    return (*sides, box((0, 0, 0.71), (1.4, 0.64, 0.03), top))


def bench(paint: Materials, _: int) -> Solids:
    wood = paint("wood")
    planks = [box((0, y, 0.42), (0.8, 0.12, 0.03), wood) for y in (-0.07, 0.07)]
    return (*planks, *(box((s * 0.34, 0, 0), (0.05, 0.26, 0.42), wood) for s in (-1, 1)))


def shelf(paint: Materials, shape: int) -> Solids:
    """Build a bookcase: shape 0 is tall, 1 is low."""
    wood = paint("wood")
    height, width = (1.8, 0.9) if shape == 0 else (0.8, 0.7)
    sides = [box((s * width / 2, 0, 0), (0.03, 0.3, height), wood) for s in (-1, 1)]
    levels = (0.08, 0.42, 0.76, 1.1, 1.44, 1.77) if shape == 0 else (0.06, 0.4, 0.77)
    boards = [box((0, 0, z), (width, 0.3, 0.025), wood) for z in levels]
    return (*sides, *boards, box((0, 0.14, 0), (width, 0.02, height), wood))


def cabinet(paint: Materials, shape: int) -> Solids:
    """Build a cabinet: shape 0 is a sideboard, 1 is a kitchen unit."""
    front, metal = paint("wood" if shape == 0 else "plastic"), paint("metal")
    width = 1.1 if shape == 0 else 1.2
    body = box((0, 0, 0.05), (width, 0.44, 0.75), front)
    doors = [
        box((x * width, -0.225, 0.1), (0.4 * width, 0.015, 0.62), front) for x in (-0.23, 0.23)
    ]
    knobs = [ball((x, -0.245, 0.5), (0.03, 0.03, 0.03), metal) for x in (-0.06, 0.06)]
    top = box((0, -0.01, 0.8), (width + 0.04, 0.5, 0.04), paint("wood"))
    return body, *doors, *knobs, top


def cushion(paint: Materials, shape: int) -> Solids:
    """Build a cushion: shape 0 has a printed pattern, 1 has plain fabric."""
    cover = paint("print" if shape == 0 else "fabric")
    return (ball((0, 0, 0), (0.44, 0.2, 0.42), cover),)


def rug(paint: Materials, shape: int) -> Solids:
    """Build a rug: shape 0 is rectangular, 1 is round."""
    if shape == 0:
        return (box((0, 0, 0), (1.7, 1.1, 0.012), paint("print")),)
    return (cylinder((0, 0, 0), 1.2, 0.012, paint("print")),)


def lamp(paint: Materials, shape: int) -> Solids:
    """Build a lamp.

    Shape 0 is a floor lamp, 1 is a table lamp with a cone shade, 2 is a ball on a rod.
    """
    metal, shade = paint("metal"), paint("fabric")
    if shape == 0:
        foot = (cylinder((0, 0, 0), 0.3, 0.03, metal), cylinder((0, 0, 0.03), 0.03, 1.3, metal))
        return (*foot, solid("lampshade", (0, 0, 1.28), (0.4, 0.4, 0.3), shade))
    if shape == 1:
        base = solid("ball", (0, 0, 0), (0.16, 0.16, 0.2), paint("ceramic"))
        return base, solid("cone", (0, 0, 0.17), (0.3, 0.3, 0.32), shade)
    rod = (cylinder((0, 0, 0), 0.18, 0.02, metal), cylinder((0, 0, 0.02), 0.02, 0.34, metal))
    return (*rod, ball((0, 0, 0.33), (0.2, 0.2, 0.2), shade))


def potted_plant(paint: Materials, shape: int) -> Solids:
    """Build a plant in a pot: shape 0 is a bush, 1 is a tree of three balls, 2 is a conifer."""
    leaves, pot = paint("leaves"), solid("bucket", (0, 0, 0), (0.3, 0.3, 0.28), paint("ceramic"))
    if shape == 0:
        return pot, ball((0, 0, 0.22), (0.5, 0.5, 0.52), leaves)
    trunk = cylinder((0, 0, 0.26), 0.04, 0.6, paint("wood"))
    if shape == 1:
        crowns = [(-0.1, 0.05, 0.7, 0.36), (0.12, 0, 0.86, 0.34), (0, -0.08, 1.05, 0.3)]
        return pot, trunk, *(ball((x, y, z), (d, d, d), leaves) for x, y, z, d in crowns)
    tiers = [(0.36, 0.5), (0.58, 0.4), (0.8, 0.3)]
    return pot, trunk, *(solid("cone", (0, 0, z), (d, d, 0.36), leaves) for z, d in tiers)


FURNITURE: dict[str, Builder] = {
    "chair": chair,
    "couch": couch,
    "bed": bed,
    "dining table": dining_table,
    "bench": bench,
    "shelf": shelf,
    "cabinet": cabinet,
    "cushion": cushion,
    "rug": rug,
    "lamp": lamp,
    "potted plant": potted_plant,
}
