"""Imports point to lower floors, and the structure stays within its bounds."""

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent

# Every package and every module at the top of ldo_service. An import may only point to a lower
# floor, so there is no loop between packages. `ldo_service` itself holds the version.
FLOORS = (
    ("errors", "ldo_service"),
    ("schemas", "kernels", "demo_networks"),
    ("geometry", "storage"),
    ("detection", "gaussians", "pose_graph", "synthetic", "cameras", "transport"),
    ("datasets", "volumes", "regions", "tracking", "runtime", "client"),
    ("semantics", "recordings"),
    ("loop_closing", "evaluation"),
    ("conversions",),
    ("maps",),
    ("actors",),
    ("config",),
    ("runs", "service"),
    ("viewer", "suites", "testing"),
    ("commands",),
    ("__main__",),
)
FLOOR = {package: number for number, packages in enumerate(FLOORS) for package in packages}
EXCEPTIONS: frozenset[tuple[str, str]] = frozenset()  # (file, imported package); none may be added
NUMERICS = (
    *("datasets", "detection", "evaluation", "gaussians", "geometry", "kernels", "loop_closing"),
    *("pose_graph", "regions", "semantics", "synthetic", "tracking", "volumes"),
)
MAX_LINES = 400  # of a file outside the kernels
MAX_TOP_MODULES = 5


def sources(package: str = "") -> list[Path]:
    """The Python files of a package of `ldo_service`, found through its links; all by default."""
    folder = ROOT / "ldo_service" / package
    links = [path.rglob("*.py") for path in folder.iterdir() if path.is_symlink()]
    return sorted({*folder.rglob("*.py"), *(path for found in links for path in found)})


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


def package_of(path: Path) -> str:
    """The package of a file, or the name of a module at the top."""
    first = path.relative_to(ROOT / "ldo_service").parts[0].removesuffix(".py")
    return "ldo_service" if first == "__init__" else first


def imported_by(package: str) -> set[tuple[str, str]]:
    """(file, imported name) of a package."""
    return {
        (str(path.relative_to(ROOT)), name)
        for path in sources(package)
        for name in imports(path, path.read_text())
    }


def arrows() -> Iterator[tuple[str, str, str]]:
    """(file, its package, imported package) of every import between packages."""
    for path in sources():
        here = package_of(path)
        for name in imports(path, path.read_text()):
            parts = name.split(".")
            if parts[0] != "ldo_service":
                continue
            there = parts[1] if len(parts) > 1 and parts[1] in FLOOR else "ldo_service"
            if there != here:
                yield str(path.relative_to(ROOT)), here, there


def offenders(package: str, forbidden: tuple[str, ...]) -> list[str]:
    prefixes = tuple(f"ldo_service.{name}" for name in forbidden)
    return [
        f"{path} imports {name}"
        for path, name in sorted(imported_by(package))
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


def test_every_package_is_found_and_has_a_floor() -> None:
    assert {package_of(path) for path in sources()} == FLOOR.keys()
    assert all(sources(package) for package in ("geometry", "schemas", "actors", "runtime"))


def test_imports_point_to_lower_floors() -> None:
    upward = {(path, there) for path, here, there in arrows() if FLOOR[there] >= FLOOR[here]}
    assert sorted(upward - EXCEPTIONS) == []
    assert sorted(EXCEPTIONS - upward) == [], "an exception that is not needed any more"


def test_few_modules_stand_at_the_top() -> None:
    loose = sorted(path.stem for path in (ROOT / "ldo_service").glob("*.py"))
    public = [name for name in loose if not name.startswith("__")]
    assert len(public) <= MAX_TOP_MODULES, public


def test_no_file_is_too_long() -> None:
    lines = {
        str(path.relative_to(ROOT)): len(path.read_text().splitlines())
        for path in sources()
        if package_of(path) != "kernels"
    }
    assert {path: count for path, count in lines.items() if count > MAX_LINES} == {}


@pytest.mark.parametrize("package", NUMERICS)
def test_numerics_know_no_message_no_runtime_and_no_actor(package: str) -> None:
    assert offenders(package, ("schemas", "runtime", "actors", "transport")) == []


def test_runtime_knows_no_actor_and_no_numerics() -> None:
    assert offenders("runtime", (*NUMERICS, "actors")) == []


def test_schemas_know_only_msgspec_numpy_and_themselves() -> None:
    names = {name for _, name in imported_by("schemas")}
    third_party = {name for name in names if name.split(".")[0] not in sys.stdlib_module_names}
    allowed = ("msgspec", "numpy", "ldo_service.schemas")
    assert [name for name in sorted(third_party) if not name.startswith(allowed)] == []


@pytest.mark.parametrize("package", sorted(FLOOR.keys() - {"pose_graph", "ldo_service"}))
def test_gtsam_is_imported_by_the_pose_graph_only(package: str) -> None:
    """It holds the interpreter's lock during every call."""
    if (ROOT / "ldo_service" / package).is_dir():
        found = [x for x in sorted(imported_by(package)) if x[1].split(".")[0] == "gtsam"]
        assert found == []
