"""Builders of small objects: vessels, fruit, bags, toys and tools."""

from ldo_service.synthetic.flat.paint import Materials

from .build import Builder, Solids, ball, box, cylinder, solid


def bottle(paint: Materials, shape: int) -> Solids:
    """Build a bottle: shape 0 is slim, 1 is wide with a cone as its shoulder."""
    glass = paint("ceramic")
    if shape == 0:
        return cylinder((0, 0, 0), 0.075, 0.2, glass), cylinder((0, 0, 0.2), 0.03, 0.1, glass)
    shoulder = solid("cone", (0, 0, 0.18), (0.11, 0.11, 0.16), glass)
    return (
        cylinder((0, 0, 0), 0.11, 0.18, glass),
        shoulder,
        cylinder((0, 0, 0.28), 0.04, 0.05, glass),
    )


def cup(paint: Materials, shape: int) -> Solids:
    """Build a cup: shape 0 is a mug with a handle, 1 is a tapered beaker."""
    glaze = paint("ceramic")
    if shape == 0:
        ear = box((0.06, 0, 0.02), (0.035, 0.015, 0.06), glaze)
        return cylinder((0, 0, 0), 0.09, 0.1, glaze), ear
    return (solid("bucket", (0, 0, 0), (0.1, 0.1, 0.12), glaze),)


def wine_glass(paint: Materials, _: int) -> Solids:
    glass = paint("plastic")
    foot = (cylinder((0, 0, 0), 0.07, 0.006, glass), cylinder((0, 0, 0.006), 0.012, 0.09, glass))
    return *foot, ball((0, 0, 0.09), (0.08, 0.08, 0.11), glass)


def bowl(paint: Materials, _: int) -> Solids:
    return (solid("bucket", (0, 0, 0), (0.26, 0.26, 0.09), paint("ceramic")),)


def vase(paint: Materials, shape: int) -> Solids:
    """Build a vase: shape 0 is round with a neck, 1 is tall and tapered."""
    glaze = paint("ceramic")
    if shape == 0:
        neck = solid("bucket", (0, 0, 0.2), (0.1, 0.1, 0.12), glaze)
        return ball((0, 0, 0), (0.2, 0.2, 0.24), glaze), neck
    return (solid("lampshade", (0, 0, 0), (0.16, 0.16, 0.36), glaze),)


def fruit(paint: Materials, _: int) -> Solids:
    return (ball((0, 0, 0), (0.085, 0.085, 0.08), paint("plastic")),)


def banana(paint: Materials, _: int) -> Solids:
    return (ball((0, 0, 0), (0.2, 0.045, 0.045), paint("plastic")),)


KITCHENWARE: dict[str, Builder] = {
    "bottle": bottle,
    "cup": cup,
    "wine glass": wine_glass,
    "bowl": bowl,
    "vase": vase,
    "apple": fruit,
    "orange": fruit,
    "banana": banana,
}


def backpack(paint: Materials, _: int) -> Solids:
    cloth, pocket = paint("fabric"), paint("fabric")
    top = ball((0, 0, 0.3), (0.32, 0.2, 0.2), cloth)
    straps = [box((s * 0.09, 0.1, 0.06), (0.04, 0.03, 0.32), pocket) for s in (-1, 1)]
    return (
        box((0, 0, 0), (0.32, 0.2, 0.4), cloth),
        top,
        box((0, -0.13, 0.04), (0.24, 0.08, 0.18), pocket),
        *straps,
    )


def suitcase(paint: Materials, shape: int) -> Solids:
    """Build a suitcase: shape 0 is upright with its handle extended, 1 is old and lies flat."""
    shell, metal = paint("plastic"), paint("metal")
    if shape == 1:
        return box((0, 0, 0), (0.6, 0.4, 0.2), paint("wood")), box(
            (0, -0.21, 0.08), (0.14, 0.03, 0.03), metal
        )
    rods = [box((s * 0.1, 0.08, 0.62), (0.02, 0.02, 0.26), metal) for s in (-1, 1)]
    bar = box((0, 0.08, 0.88), (0.24, 0.03, 0.03), metal)
    return box((0, 0, 0.05), (0.4, 0.24, 0.57), shell), *rods, bar


def handbag(paint: Materials, _: int) -> Solids:
    leather = paint("fabric")
    rods = [box((s * 0.09, 0, 0.22), (0.015, 0.015, 0.14), leather) for s in (-1, 1)]
    return (
        solid("lampshade", (0, 0, 0), (0.34, 0.14, 0.23), leather),
        *rods,
        box((0, 0, 0.35), (0.195, 0.015, 0.015), leather),
    )


def umbrella(paint: Materials, _: int) -> Solids:
    """Build a folded umbrella that stands on its tip."""
    rod = cylinder((0, 0, 0), 0.014, 0.88, paint("metal"))
    return (
        rod,
        solid("bucket", (0, 0, 0.08), (0.1, 0.1, 0.6), paint("fabric")),
        ball((0, 0, 0.85), (0.1, 0.035, 0.05), paint("wood")),
    )


def sports_ball(paint: Materials, _: int) -> Solids:
    return (ball((0, 0, 0), (0.24, 0.24, 0.24), paint("print")),)


def skateboard(paint: Materials, _: int) -> Solids:
    """Build a skateboard that stands on its tail, flat against the wall."""
    wheels = [
        solid("wheel", (s * 0.09, -0.05, z), (0.04, 0.06, 0.06), paint("plastic"))
        for s in (-1, 1)
        for z in (0.15, 0.58)
    ]
    return box((0, 0, 0), (0.2, 0.02, 0.8), paint("print")), *wheels


def teddy_bear(paint: Materials, _: int) -> Solids:
    fur = paint("fabric")
    ears = [ball((s * 0.07, 0, 0.36), (0.07, 0.04, 0.07), fur) for s in (-1, 1)]
    limbs = [ball((s * 0.12, -0.06, z), (0.1, 0.18, 0.1), fur) for s in (-1, 1) for z in (0, 0.14)]
    return (
        ball((0, 0, 0), (0.24, 0.2, 0.26), fur),
        ball((0, 0, 0.22), (0.19, 0.18, 0.18), fur),
        *ears,
        *limbs,
    )


def fire_extinguisher(paint: Materials, _: int) -> Solids:
    metal = paint("metal")
    body = (
        cylinder((0, 0, 0.02), 0.15, 0.4, paint("plastic")),
        ball((0, 0, 0.35), (0.15, 0.15, 0.14), metal),
    )
    return (
        *body,
        cylinder((0, 0, 0.47), 0.04, 0.06, metal),
        box((0, -0.05, 0.52), (0.03, 0.16, 0.025), metal),
    )


def ladder(paint: Materials, _: int) -> Solids:
    metal = paint("metal")
    rails = [box((s * 0.2, 0, 0), (0.04, 0.06, 1.9), metal) for s in (-1, 1)]
    return *rails, *(
        box((0, 0, 0.25 + 0.28 * i), (0.38, 0.05, 0.03), metal) for i in (0, 1, 2, 3, 4, 5)
    )


def broom(paint: Materials, _: int) -> Solids:
    return cylinder((0, 0, 0.16), 0.028, 1.2, paint("wood")), solid(
        "lampshade", (0, 0, 0), (0.36, 0.07, 0.17), paint("fabric")
    )


def bucket(paint: Materials, _: int) -> Solids:
    return solid("bucket", (0, 0, 0), (0.3, 0.3, 0.28), paint("plastic")), cylinder(
        (0, 0, 0.279), 0.26, 0.004, paint("screen")
    )


def cardboard_box(paint: Materials, shape: int) -> Solids:
    """Build a cardboard box: shape 0 is one box, 1 has a smaller box on top."""
    first = box((0, 0, 0), (0.46, 0.36, 0.32), paint("plastic"))
    tape = box((0, 0, 0.32), (0.06, 0.36, 0.003), paint("wood"))
    if shape == 0:
        return first, tape
    return first, tape, box((0.04, 0, 0.323), (0.3, 0.26, 0.22), paint("plastic"), (0.8, 0.6))


def toolbox(paint: Materials, _: int) -> Solids:
    metal = paint("metal")
    return (
        box((0, 0, 0), (0.42, 0.2, 0.17), paint("plastic")),
        box((0, 0, 0.17), (0.38, 0.16, 0.05), metal),
        box((0, 0, 0.25), (0.2, 0.03, 0.03), metal),
    )


def trash_can(paint: Materials, shape: int) -> Solids:
    """Build a bin: shape 0 widens upward, 1 is a cylinder with a dome."""
    if shape == 0:
        return (solid("bucket", (0, 0, 0), (0.28, 0.28, 0.36), paint("plastic")),)
    case = paint("metal")
    return cylinder((0, 0, 0), 0.3, 0.55, case), ball((0, 0, 0.45), (0.3, 0.3, 0.2), case)


BELONGINGS: dict[str, Builder] = {
    "backpack": backpack,
    "suitcase": suitcase,
    "handbag": handbag,
    "umbrella": umbrella,
    "sports ball": sports_ball,
    "skateboard": skateboard,
    "teddy bear": teddy_bear,
    "fire extinguisher": fire_extinguisher,
    "ladder": ladder,
    "broom": broom,
    "bucket": bucket,
    "cardboard box": cardboard_box,
    "toolbox": toolbox,
    "trash can": trash_can,
}
