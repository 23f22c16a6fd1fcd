"""Architecture: imports point to lower layers, and files and packages stay within bounds."""

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent

# Every package and every top-level module of ldo_service. An import may only point to a lower
# layer, so there is no import cycle between packages. `ldo_service` itself contains the version.
LAYERS = (
    ("errors", "ldo_service"),
    ("storage",),
    ("schemas", "kernels", "demo_networks"),
    ("geometry",),
    ("calibration",),
    ("detection", "gaussians", "pose_graph", "synthetic", "cameras", "transport"),
    ("datasets", "volumes", "regions", "tracking", "runtime", "client"),
    ("semantics", "recordings"),
    ("loop_closing", "evaluation"),
    ("conversions",),
    ("maps",),
    ("actors",),
    ("config",),
    ("runs", "service"),
    ("batch",),
    ("viewer", "suites", "testing", "library"),
    ("commands",),
    ("__main__",),
)
LAYER = {package: number for number, packages in enumerate(LAYERS) for package in packages}
# Pairs of file and imported package. Add none.
EXCEPTIONS: frozenset[tuple[str, str]] = frozenset()
NUMERICS = (
    *(
        "calibration",
        "datasets",
        "detection",
        "evaluation",
        "gaussians",
        "geometry",
        "kernels",
        "loop_closing",
    ),
    *("pose_graph", "regions", "semantics", "synthetic", "tracking", "volumes"),
)
MAX_LINES = 400  # Maximum length of a file outside the kernels.
MAX_TOP_MODULES = 5


def sources(package: str = "") -> list[Path]:
    """Return the Python files of a package of `ldo_service`; all packages by default.

    `ldo_service/actors` and `ldo_service/schemas` are links, which `rglob` does not follow.
    """
    folder = ROOT / "ldo_service" / package
    links = [path.rglob("*.py") for path in folder.iterdir() if path.is_symlink()]
    return sorted({*folder.rglob("*.py"), *(path for found in links for path in found)})


def imports(path: Path, source: str) -> Iterator[str]:
    """Yield the absolute dotted names of all imports in a file, nested ones included."""
    package = path.relative_to(ROOT).with_suffix("").parts[:-1]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            module = ".".join((*base, *([node.module] if node.module else [])))
            yield from (f"{module}.{alias.name}" for alias in node.names)


def package_of(path: Path) -> str:
    """Return the package of a file, or the name of a top-level module."""
    first = path.relative_to(ROOT / "ldo_service").parts[0].removesuffix(".py")
    return "ldo_service" if first == "__init__" else first


def imported_by(package: str) -> set[tuple[str, str]]:
    """Return all pairs of file and imported name of a package."""
    return {
        (str(path.relative_to(ROOT)), name)
        for path in sources(package)
        for name in imports(path, path.read_text())
    }


def cross_package_imports() -> Iterator[tuple[str, str, str]]:
    """Yield file, its package and the imported package of every import between packages.

    The package root is left out: it loads the public names of higher layers when they are used.
    """
    for path in sources():
        here = package_of(path)
        if here == "ldo_service":
            continue
        for name in imports(path, path.read_text()):
            parts = name.split(".")
            if parts[0] != "ldo_service":
                continue
            there = parts[1] if len(parts) > 1 and parts[1] in LAYER else "ldo_service"
            if there != here:
                yield str(path.relative_to(ROOT)), here, there


def forbidden_imports(package: str, forbidden: tuple[str, ...]) -> list[str]:
    """Return one line per import of a forbidden package."""
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


def test_every_package_has_a_layer() -> None:
    assert {package_of(path) for path in sources()} == LAYER.keys()
    assert all(sources(package) for package in ("geometry", "schemas", "actors", "runtime"))


def test_imports_point_to_lower_layers() -> None:
    found = cross_package_imports()
    upward = {(path, there) for path, here, there in found if LAYER[there] >= LAYER[here]}
    assert sorted(upward - EXCEPTIONS) == []
    assert sorted(EXCEPTIONS - upward) == [], "remove the exceptions that are no longer needed"


def test_package_root_has_few_public_modules() -> None:
    modules = sorted(path.stem for path in (ROOT / "ldo_service").glob("*.py"))
    public = [name for name in modules if not name.startswith("__")]
    assert len(public) <= MAX_TOP_MODULES, public


def test_no_file_exceeds_max_lines() -> None:
    lines = {
        str(path.relative_to(ROOT)): len(path.read_text().splitlines())
        for path in sources()
        if package_of(path) != "kernels"
    }
    assert {path: count for path, count in lines.items() if count > MAX_LINES} == {}


@pytest.mark.parametrize("package", NUMERICS)
def test_numerics_import_no_messages_runtime_or_actors(package: str) -> None:
    assert forbidden_imports(package, ("schemas", "runtime", "actors", "transport")) == []


def test_runtime_imports_no_actors_or_numerics() -> None:
    assert forbidden_imports("runtime", (*NUMERICS, "actors")) == []


def test_schemas_import_only_msgspec_numpy_and_schemas() -> None:
    names = {name for _, name in imported_by("schemas")}
    third_party = {name for name in names if name.split(".")[0] not in sys.stdlib_module_names}
    allowed = ("msgspec", "numpy", "ldo_service.schemas")
    assert [name for name in sorted(third_party) if not name.startswith(allowed)] == []


@pytest.mark.parametrize("package", sorted(LAYER.keys() - {"pose_graph", "ldo_service"}))
def test_only_pose_graph_imports_gtsam(package: str) -> None:
    """Every call of gtsam holds the interpreter lock."""
    if (ROOT / "ldo_service" / package).is_dir():
        found = [x for x in sorted(imported_by(package)) if x[1].split(".")[0] == "gtsam"]
        assert found == []
