"""What stands on tables: vessels and fruit."""

from ldo_service.datasets.synthetic.flat.paint import Paints

from .build import Builder, Solids, ball, box, cylinder, solid


def bottle(paint: Paints, shape: int) -> Solids:
    """Slim with a neck, or wide with a cone for a shoulder."""
    glass = paint("ceramic")
    if shape == 0:
        return cylinder((0, 0, 0), 0.075, 0.2, glass), cylinder((0, 0, 0.2), 0.03, 0.1, glass)
    shoulder = solid("cone", (0, 0, 0.18), (0.11, 0.11, 0.16), glass)
    return (
        cylinder((0, 0, 0), 0.11, 0.18, glass),
        shoulder,
        cylinder((0, 0, 0.28), 0.04, 0.05, glass),
    )


def cup(paint: Paints, shape: int) -> Solids:
    """A mug with an ear, or a tapered beaker."""
    glaze = paint("ceramic")
    if shape == 0:
        ear = box((0.06, 0, 0.02), (0.035, 0.015, 0.06), glaze)
        return cylinder((0, 0, 0), 0.09, 0.1, glaze), ear
    return (solid("bucket", (0, 0, 0), (0.1, 0.1, 0.12), glaze),)


def wine_glass(paint: Paints, _: int) -> Solids:
    glass = paint("plastic")
    foot = (cylinder((0, 0, 0), 0.07, 0.006, glass), cylinder((0, 0, 0.006), 0.012, 0.09, glass))
    return *foot, ball((0, 0, 0.09), (0.08, 0.08, 0.11), glass)


def bowl(paint: Paints, _: int) -> Solids:
    return (solid("bucket", (0, 0, 0), (0.26, 0.26, 0.09), paint("ceramic")),)


def vase(paint: Paints, shape: int) -> Solids:
    """A belly with a neck, or a tall taper."""
    glaze = paint("ceramic")
    if shape == 0:
        neck = solid("bucket", (0, 0, 0.2), (0.1, 0.1, 0.12), glaze)
        return ball((0, 0, 0), (0.2, 0.2, 0.24), glaze), neck
    return (solid("lampshade", (0, 0, 0), (0.16, 0.16, 0.36), glaze),)


def fruit(paint: Paints, _: int) -> Solids:
    return (ball((0, 0, 0), (0.085, 0.085, 0.08), paint("plastic")),)


def banana(paint: Paints, _: int) -> Solids:
    return (ball((0, 0, 0), (0.2, 0.045, 0.045), paint("plastic")),)


BUILDERS: dict[str, Builder] = {
    "bottle": bottle,
    "cup": cup,
    "wine glass": wine_glass,
    "bowl": bowl,
    "vase": vase,
    "apple": fruit,
    "orange": fruit,
    "banana": banana,
}
