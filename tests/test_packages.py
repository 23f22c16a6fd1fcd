"""Built packages contain all tracked files; links to folders are easily lost in them."""

import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]


def tracked() -> set[str]:
    """Return the files under version control, without links to folders."""
    done = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        pytest.skip("needs a git checkout, whose tracked files are the expected contents")
    return {name for name in done.stdout.split("\0") if name and (ROOT / name).is_file()}


@pytest.fixture(scope="module")
def packages(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a new sdist and the wheel built from it."""
    out = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(out), str(ROOT)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    return out


def test_wheel_contains_every_module_and_network(packages: Path) -> None:
    (wheel,) = packages.glob("*.whl")
    packed = set(zipfile.ZipFile(wheel).namelist())
    for name in tracked():
        if not name.endswith((".py", ".pyi", ".yaml", ".onnx", ".npz", ".tsv", "CARD.md")):
            continue
        if name.startswith("ldo_service/"):
            assert name in packed
        elif name.startswith(("actors/", "schemas/")):
            assert f"ldo_service/{name}" in packed


def test_wheel_contains_compiled_kernels_and_types_without_sources(packages: Path) -> None:
    (wheel,) = packages.glob("*.whl")
    packed = set(zipfile.ZipFile(wheel).namelist())
    modules = {n for n in tracked() if n.endswith("_module.cpp")}
    for module in modules:
        folder, _, name = module.removesuffix("_module.cpp").rpartition("/")
        stem = f"{folder}/_{name}"
        assert any(name.startswith(stem + ".") and name.endswith(".so") for name in packed), module
    assert "ldo_service/py.typed" in packed
    assert not [name for name in packed if name.endswith((".cpp", ".hpp", ".pyc"))]
    assert {name.split("/")[0] for name in packed if ".dist-info" not in name} == {"ldo_service"}


def test_sdist_contains_all_files_of_a_build(packages: Path) -> None:
    (sdist,) = packages.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        packed = {name.split("/", 1)[-1] for name in archive.getnames()}
    needed = {
        name
        for name in tracked()
        if name.startswith(("ldo_service/", "actors/", "schemas/"))
        or name in ("CMakeLists.txt", "LICENSE", "README.md", "pyproject.toml")
    }
    assert needed - packed == set()
    assert not [name for name in packed if name.startswith((".ci", "build/"))]


def without_compiler(folder: Path, *tools: str) -> dict[str, str]:
    """Return an environment with only these tools on its PATH, which is `folder`."""
    folder.mkdir(exist_ok=True)
    for tool in tools:
        found = shutil.which(tool, path=f"{Path(sys.executable).parent}:{os.environ['PATH']}")
        if found is None:
            pytest.skip(f"needs {tool}, which only an isolated build installs by itself")
        (folder / tool).symlink_to(found)
    kept = {name: value for name, value in os.environ.items() if name not in ("CC", "CXX")}
    return {**kept, "PATH": str(folder)}


def test_wheel_installs_and_runs_without_a_compiler(packages: Path, tmp_path: Path) -> None:
    """A new virtual environment gets the wheel and all of its dependencies."""
    (wheel,) = packages.glob("*.whl")
    subprocess.run([sys.executable, "-m", "venv", str(tmp_path / "venv")], check=True)
    ours = tmp_path / "venv" / "bin"
    environment = without_compiler(tmp_path / "bin")
    install = [ours / "python", "-m", "pip", "install", "--quiet", "--only-binary", ":all:", wheel]
    done = subprocess.run(install, env=environment, capture_output=True, text=True)
    if "No matching distribution" in done.stderr or "ConnectionError" in done.stderr:
        pytest.skip("needs a package index to install the dependencies of the wheel")
    assert done.returncode == 0, done.stderr[-3000:]
    run = [ours / "ldo", "run", "synthetic:room", "--max-frames", "3", "--out", tmp_path / "out"]
    done = subprocess.run(run, env=environment, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr[-3000:]
    assert (tmp_path / "out" / "map.ply").is_file()


def test_build_without_a_compiler_reports_it_in_one_line(tmp_path: Path) -> None:
    environment = without_compiler(tmp_path / "bin", "cmake", "ninja")
    command = [sys.executable, "-m", "pip", "install", "--no-build-isolation", "--no-deps"]
    command += ["--target", str(tmp_path / "target"), "-C", f"build-dir={tmp_path / 'build'}"]
    done = subprocess.run([*command, str(ROOT)], env=environment, capture_output=True, text=True)
    assert done.returncode != 0
    (line,) = [line for line in done.stderr.splitlines() if "finds no C++17 compiler" in line]
    assert "apt install g++" in line
