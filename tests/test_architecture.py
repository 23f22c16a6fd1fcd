"""Imports point one way: schemas <- runtime <- actors, and numerics <- actors."""

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
NUMERICS = (
    "datasets",
    "detection",
    "evaluation",
    "gaussians",
    "geometry",
    "kernels",
    "loop_closing",
    "pose_graph",
    "regions",
    "semantics",
    "synthetic",
    "tracking",
    "volumes",
)
OUR_ROOMS = (*NUMERICS, "runtime", "schemas", "actors")


def sources(room: str) -> list[Path]:
    """The Python files of a room of `ldo_service`, found through its links."""
    return sorted((ROOT / "ldo_service" / room).rglob("*.py"))


def imports(path: Path, source: str) -> Iterator[str]:
    """Absolute dotted names of everything that a file imports, at any depth."""
    package = path.relative_to(ROOT).with_suffix("").parts[:-1]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            module = ".".join((*base, *([node.module] if node.module else [])))
            yield from (f"{module}.{alias.name}" for alias in node.names)


def imported_by(room: str) -> set[tuple[str, str]]:
    """(file, imported name) of a room."""
    return {
        (str(path.relative_to(ROOT)), name)
        for path in sources(room)
        for name in imports(path, path.read_text())
    }


def offenders(room: str, forbidden: tuple[str, ...]) -> list[str]:
    prefixes = tuple(f"ldo_service.{name}" for name in forbidden)
    return [
        f"{path} imports {name}"
        for path, name in sorted(imported_by(room))
        if any(name == prefix or name.startswith(prefix + ".") for prefix in prefixes)
    ]


def test_relative_imports_are_resolved() -> None:
    path = ROOT / "ldo_service/tracking/alignment.py"
    source = "from . import a\nfrom ..pose_graph import b\nfrom .c import d\nimport e.f\n"
    assert list(imports(path, source)) == [
        "ldo_service.tracking.a",
        "ldo_service.pose_graph.b",
        "ldo_service.tracking.c.d",
        "e.f",
    ]


def test_every_room_is_found() -> None:
    assert all(sources(room) for room in ("geometry", "schemas", "actors", "runtime"))


@pytest.mark.parametrize("room", NUMERICS)
def test_numerics_know_no_message_no_runtime_and_no_actor(room: str) -> None:
    assert offenders(room, ("schemas", "runtime", "actors")) == []


def test_runtime_knows_no_actor_and_no_numerics() -> None:
    assert offenders("runtime", (*NUMERICS, "actors")) == []


def test_schemas_know_only_msgspec_numpy_and_themselves() -> None:
    names = {name for _, name in imported_by("schemas")}
    third_party = {name for name in names if name.split(".")[0] not in sys.stdlib_module_names}
    allowed = ("msgspec", "numpy", "ldo_service.schemas")
    assert [name for name in sorted(third_party) if not name.startswith(allowed)] == []


@pytest.mark.parametrize("room", [room for room in OUR_ROOMS if room != "pose_graph"])
def test_gtsam_is_imported_by_the_pose_graph_only(room: str) -> None:
    """It holds the interpreter's lock during every call."""
    assert [x for x in sorted(imported_by(room)) if x[1].split(".")[0] == "gtsam"] == []
