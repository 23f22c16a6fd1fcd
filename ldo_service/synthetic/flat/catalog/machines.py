"""Builders of appliances, and of objects on desks and walls."""

from ldo_service.synthetic.flat.paint import Materials

from .build import Builder, Solids, ball, box, cylinder, legs, solid


def tv(paint: Materials, shape: int) -> Solids:
    """Build a TV: shape 0 stands on a foot, shape 1 is smaller and is mounted on a wall."""
    case, width = paint("plastic"), 1.0 if shape == 0 else 0.8
    height = 0.56 * width
    z = 0.06 if shape == 0 else 0.0
    panel = box((0, 0, z), (width, 0.05, height), case)
    glass = box((0, -0.027, z + 0.02), (width - 0.04, 0.004, height - 0.04), paint("screen"))
    foot = (box((0, 0, 0), (0.4, 0.2, 0.02), case), box((0, 0, 0.02), (0.08, 0.05, 0.05), case))
    return (panel, glass, *foot) if shape == 0 else (panel, glass)


def refrigerator(paint: Materials, _: int) -> Solids:
    case, metal = paint("plastic"), paint("metal")
    doors = [box((0, -0.31, z), (0.58, 0.03, h), case) for z, h in ((0.06, 1.0), (1.09, 0.58))]
    grips = [box((-0.24, -0.34, z), (0.02, 0.03, h), metal) for z, h in ((0.6, 0.36), (1.15, 0.3))]
    return box((0, 0, 0.03), (0.6, 0.6, 1.68), case), *doors, *grips


def oven(paint: Materials, _: int) -> Solids:
    case, metal, glass = paint("metal"), paint("metal"), paint("screen")
    plates = [(x, y) for x in (-0.14, 0.14) for y in (-0.12, 0.14)]
    knobs = [solid("ball", (x, -0.3, 0.74), (0.04, 0.04, 0.04), metal) for x in (-0.2, 0, 0.2)]
    return (
        box((0, 0, 0.04), (0.6, 0.56, 0.8), case),
        box((0, -0.285, 0.16), (0.48, 0.02, 0.42), glass),
        box((0, -0.31, 0.62), (0.46, 0.03, 0.03), metal),
        *knobs,
        *(cylinder((x, y, 0.84), 0.2, 0.012, glass) for x, y in plates),
    )


def microwave(paint: Materials, _: int) -> Solids:
    case = paint("metal")
    return (
        box((0, 0, 0.01), (0.48, 0.34, 0.28), case),
        box((-0.07, -0.172, 0.04), (0.3, 0.008, 0.22), paint("screen")),
        box((0.18, -0.172, 0.04), (0.09, 0.01, 0.22), paint("plastic")),
    )


def toaster(paint: Materials, _: int) -> Solids:
    case = paint("metal")
    slots = [box((0, y, 0.2), (0.22, 0.03, 0.004), paint("screen")) for y in (-0.04, 0.04)]
    return box((0, 0, 0.01), (0.28, 0.18, 0.19), case), *slots


def sink(paint: Materials, _: int) -> Solids:
    """Build a basin on a column, with a tap."""
    glaze, metal = paint("ceramic"), paint("metal")
    return (
        cylinder((0, 0.05, 0), 0.18, 0.7, glaze),
        solid("bucket", (0, 0, 0.68), (0.56, 0.44, 0.18), glaze),
        solid("cylinder", (0, -0.02, 0.858), (0.42, 0.3, 0.006), paint("screen")),
        cylinder((0, 0.18, 0.86), 0.03, 0.16, metal),
        box((0, 0.1, 1.0), (0.025, 0.16, 0.025), metal),
    )


def toilet(paint: Materials, _: int) -> Solids:
    glaze = paint("ceramic")
    return (
        solid("bucket", (0, -0.12, 0), (0.38, 0.5, 0.4), glaze),
        solid("cylinder", (0, -0.12, 0.4), (0.4, 0.5, 0.035), paint("plastic")),
        box((0, 0.2, 0.36), (0.4, 0.18, 0.4), glaze),
    )


def speaker(paint: Materials, shape: int) -> Solids:
    """Build a speaker: shape 0 is a tower, shape 1 is a small shelf speaker."""
    case, cone = paint("wood"), paint("screen")
    height, width = (0.8, 0.22) if shape == 0 else (0.3, 0.18)
    at = [(0.3 * height, 0.16), (0.68 * height, 0.12)]
    cones = [box((0, -0.112, z), (d, 0.01, d), cone) for z, d in at]
    return box((0, 0, 0), (width, 0.22, height), case), *cones


def fan(paint: Materials, _: int) -> Solids:
    metal, blade = paint("metal"), paint("plastic")
    disc = solid("wheel", (0, 0, 0.95), (0.04, 0.4, 0.4), blade, (0.0, 1.0))
    foot = (cylinder((0, 0, 0), 0.34, 0.03, metal), cylinder((0, 0, 0.03), 0.03, 1.0, metal))
    return *foot, disc, ball((0, 0, 1.09), (0.12, 0.16, 0.12), metal)


def radiator(paint: Materials, _: int) -> Solids:
    white = paint("plastic")
    ribs = [
        box((x / 10, 0, 0.12), (0.07, 0.09, 0.6), white) for x in (-4, -3, -2, -1, 0, 1, 2, 3, 4)
    ]
    pipes = [box((0, 0, z), (0.9, 0.05, 0.05), white) for z in (0.16, 0.62)]
    return *ribs, *pipes


def projector(paint: Materials, _: int) -> Solids:
    """Build a projector on a stand."""
    case, metal = paint("plastic"), paint("metal")
    lens = solid("wheel", (-0.07, -0.14, 0.93), (0.06, 0.09, 0.09), paint("screen"), (0.0, 1.0))
    table = box((0, 0, 0.86), (0.42, 0.34, 0.02), metal)
    return (
        *legs(0.4, 0.32, 0.86, 0.03, metal),
        table,
        box((0, 0, 0.88), (0.34, 0.25, 0.13), case),
        lens,
    )


def printer(paint: Materials, _: int) -> Solids:
    case = paint("plastic")
    return (
        box((0, 0, 0), (0.42, 0.36, 0.2), case),
        box((0, 0.06, 0.2), (0.36, 0.22, 0.06), paint("plastic")),
        box((0, -0.2, 0.05), (0.3, 0.12, 0.02), paint("screen")),
    )


APPLIANCES: dict[str, Builder] = {
    "tv": tv,
    "refrigerator": refrigerator,
    "oven": oven,
    "microwave": microwave,
    "toaster": toaster,
    "sink": sink,
    "toilet": toilet,
    "speaker": speaker,
    "fan": fan,
    "radiator": radiator,
    "projector": projector,
    "printer": printer,
}


def laptop(paint: Materials, _: int) -> Solids:
    case = paint("metal")
    return (
        box((0, 0, 0), (0.34, 0.23, 0.018), case),
        box((0, -0.01, 0.018), (0.29, 0.12, 0.003), paint("screen")),
        box((0, 0.12, 0.01), (0.34, 0.012, 0.23), case),
        box((0, 0.113, 0.025), (0.32, 0.003, 0.2), paint("picture")),
    )


def keyboard(paint: Materials, _: int) -> Solids:
    case = paint("plastic")
    return box((0, 0, 0), (0.42, 0.14, 0.02), case), box(
        (0, 0, 0.02), (0.4, 0.12, 0.006), paint("books")
    )


def mouse(paint: Materials, _: int) -> Solids:
    return (ball((0, 0, 0), (0.06, 0.1, 0.045), paint("plastic")),)


def remote(paint: Materials, _: int) -> Solids:
    return box((0, 0, 0), (0.05, 0.18, 0.02), paint("plastic")), box(
        (0, 0, 0.02), (0.04, 0.14, 0.003), paint("print")
    )


def cell_phone(paint: Materials, _: int) -> Solids:
    return box((0, 0, 0), (0.075, 0.155, 0.009), paint("plastic")), box(
        (0, 0, 0.009), (0.068, 0.145, 0.001), paint("screen")
    )


def book(paint: Materials, shape: int) -> Solids:
    """Build books: shape 0 is one flat book, 1 is a stack, 2 is a standing row."""
    if shape == 0:
        return (box((0, 0, 0), (0.17, 0.24, 0.035), paint("print"), (0.96, 0.28)),)
    if shape == 1:
        turns = ((1.0, 0.0), (0.96, 0.28), (0.8, -0.6))
        sizes = ((0.22, 0.28, 0.04), (0.2, 0.26, 0.035), (0.17, 0.23, 0.03))
        stack = zip((0.0, 0.04, 0.075), sizes, turns, strict=True)
        return tuple(box((0, 0, z), size, paint("print"), turn) for z, size, turn in stack)
    return (box((0, 0, 0), (0.6, 0.2, 0.26), paint("books")),)


def clock(paint: Materials, shape: int) -> Solids:
    """Build a wall clock with a pale face and dark hands: shape 0 is round, 1 is square."""
    rim, hand = paint("plastic"), paint("screen")
    body = solid("wheel", (0, -0.02, -0.16), (0.04, 0.32, 0.32), rim, (0.0, 1.0))
    if shape == 1:
        body = box((0, -0.02, -0.15), (0.3, 0.04, 0.3), rim)
    hands = (
        box((0, -0.043, 0), (0.014, 0.004, 0.13), hand),
        box((0.045, -0.043, -0.01), (0.1, 0.004, 0.018), hand),
    )
    return body, *hands


def picture_frame(paint: Materials, shape: int) -> Solids:
    """Build a picture frame for the wall: shape 0 is portrait, 1 is landscape, 2 is square."""
    width, height = ((0.5, 0.64), (0.9, 0.6), (0.34, 0.34))[shape]
    rim = box((0, -0.015, -height / 2), (width, 0.03, height), paint("wood"))
    inner = (width - 0.08, 0.004, height - 0.08)
    return rim, box((0, -0.032, 0.04 - height / 2), inner, paint("picture"))


def whiteboard(paint: Materials, _: int) -> Solids:
    rim = paint("metal")
    return (
        box((0, -0.01, -0.45), (1.5, 0.02, 0.9), "wall_c"),
        *(box((0, -0.015, z), (1.52, 0.03, 0.025), rim) for z in (-0.46, 0.44)),
        *(box((s * 0.75, -0.015, -0.45), (0.025, 0.03, 0.9), rim) for s in (-1, 1)),
        box((0.2, -0.05, -0.47), (0.4, 0.07, 0.015), rim),
        box((-0.35, -0.021, 0.02), (0.4, 0.004, 0.26), paint("picture")),
    )


def globe(paint: Materials, _: int) -> Solids:
    foot = (
        cylinder((0, 0, 0), 0.18, 0.02, paint("wood")),
        cylinder((0, 0, 0.02), 0.02, 0.08, paint("metal")),
    )
    return *foot, ball((0, 0, 0.08), (0.28, 0.28, 0.28), paint("picture"))


OFFICE: dict[str, Builder] = {
    "laptop": laptop,
    "keyboard": keyboard,
    "mouse": mouse,
    "remote": remote,
    "cell phone": cell_phone,
    "book": book,
    "clock": clock,
    "picture frame": picture_frame,
    "whiteboard": whiteboard,
    "globe": globe,
}
