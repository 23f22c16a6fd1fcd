"""What stands on desks and hangs on walls."""

from ldo_service.datasets.synthetic.flat.paint import Paints

from .build import Builder, Solids, ball, box, cylinder, solid


def laptop(paint: Paints, _: int) -> Solids:
    case = paint("metal")
    return (
        box((0, 0, 0), (0.34, 0.23, 0.018), case),
        box((0, -0.01, 0.018), (0.29, 0.12, 0.003), paint("screen")),
        box((0, 0.12, 0.01), (0.34, 0.012, 0.23), case),
        box((0, 0.113, 0.025), (0.32, 0.003, 0.2), paint("picture")),
    )


def keyboard(paint: Paints, _: int) -> Solids:
    case = paint("plastic")
    return box((0, 0, 0), (0.42, 0.14, 0.02), case), box(
        (0, 0, 0.02), (0.4, 0.12, 0.006), paint("books")
    )


def mouse(paint: Paints, _: int) -> Solids:
    return (ball((0, 0, 0), (0.06, 0.1, 0.045), paint("plastic")),)


def remote(paint: Paints, _: int) -> Solids:
    return box((0, 0, 0), (0.05, 0.18, 0.02), paint("plastic")), box(
        (0, 0, 0.02), (0.04, 0.14, 0.003), paint("print")
    )


def cell_phone(paint: Paints, _: int) -> Solids:
    return box((0, 0, 0), (0.075, 0.155, 0.009), paint("plastic")), box(
        (0, 0, 0.009), (0.068, 0.145, 0.001), paint("screen")
    )


def book(paint: Paints, shape: int) -> Solids:
    """One lying, a stack, or a row standing."""
    if shape == 0:
        return (box((0, 0, 0), (0.17, 0.24, 0.035), paint("print"), (0.96, 0.28)),)
    if shape == 1:
        turns = ((1.0, 0.0), (0.96, 0.28), (0.8, -0.6))
        sizes = ((0.22, 0.28, 0.04), (0.2, 0.26, 0.035), (0.17, 0.23, 0.03))
        stack = zip((0.0, 0.04, 0.075), sizes, turns, strict=True)
        return tuple(box((0, 0, z), size, paint("print"), turn) for z, size, turn in stack)
    return (box((0, 0, 0), (0.6, 0.2, 0.26), paint("books")),)


def clock(paint: Paints, shape: int) -> Solids:
    """Round or square, to hang up; the face is pale, the hands are dark."""
    rim, hand = paint("plastic"), paint("screen")
    body = solid("wheel", (0, -0.02, -0.16), (0.04, 0.32, 0.32), rim, (0.0, 1.0))
    if shape == 1:
        body = box((0, -0.02, -0.15), (0.3, 0.04, 0.3), rim)
    hands = (
        box((0, -0.043, 0), (0.014, 0.004, 0.13), hand),
        box((0.045, -0.043, -0.01), (0.1, 0.004, 0.018), hand),
    )
    return body, *hands


def picture_frame(paint: Paints, shape: int) -> Solids:
    """Upright or wide, to hang up; the origin is the middle of its back."""
    width, height = ((0.5, 0.64), (0.9, 0.6), (0.34, 0.34))[shape]
    rim = box((0, -0.015, -height / 2), (width, 0.03, height), paint("wood"))
    inner = (width - 0.08, 0.004, height - 0.08)
    return rim, box((0, -0.032, 0.04 - height / 2), inner, paint("picture"))


def whiteboard(paint: Paints, _: int) -> Solids:
    rim = paint("metal")
    return (
        box((0, -0.01, -0.45), (1.5, 0.02, 0.9), "wall_c"),
        *(box((0, -0.015, z), (1.52, 0.03, 0.025), rim) for z in (-0.46, 0.44)),
        *(box((s * 0.75, -0.015, -0.45), (0.025, 0.03, 0.9), rim) for s in (-1, 1)),
        box((0.2, -0.05, -0.47), (0.4, 0.07, 0.015), rim),
        box((-0.35, -0.021, 0.02), (0.4, 0.004, 0.26), paint("picture")),
    )


def globe(paint: Paints, _: int) -> Solids:
    foot = (
        cylinder((0, 0, 0), 0.18, 0.02, paint("wood")),
        cylinder((0, 0, 0.02), 0.02, 0.08, paint("metal")),
    )
    return *foot, ball((0, 0, 0.08), (0.28, 0.28, 0.28), paint("picture"))


BUILDERS: dict[str, Builder] = {
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
