"""Built packages contain all tracked files; links to folders are easily lost in them."""

import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import nanobind
import pytest

ROOT = Path(__file__).parent.parent
pytestmark = [pytest.mark.slow, pytest.mark.timeout(600), pytest.mark.xdist_group("packages")]


def tracked() -> set[str]:
    """Return the files under version control, without links to folders."""
    done = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        pytest.skip("needs a git checkout, whose tracked files are the expected contents")
    return {name for name in done.stdout.split("\0") if name and (ROOT / name).is_file()}


def build(source: Path, out: Path, *options: str) -> Path:
    """Build packages of a folder in `out`, and return `out`."""
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(out), *options]
    done = subprocess.run([*command, str(source)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    return out


@pytest.fixture(scope="module")
def packages(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a new sdist and a new wheel.

    The wheel is built from the checkout, where the kernels are compiled already.
    """
    return build(ROOT, tmp_path_factory.mktemp("dist"), "--sdist", "--wheel")


@pytest.fixture(scope="module")
def unpacked(packages: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of the unpacked sdist."""
    (sdist,) = packages.glob("*.tar.gz")
    folder = tmp_path_factory.mktemp("sdist")
    with tarfile.open(sdist) as archive:
        archive.extractall(folder, filter="data")
    (root,) = folder.iterdir()
    return root


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


def test_sdist_contains_all_files_of_a_build(unpacked: Path) -> None:
    needed = {
        name
        for name in tracked()
        if name.startswith(("ldo_service/", "actors/", "schemas/"))
        or name in ("CMakeLists.txt", "LICENSE", "README.md", "pyproject.toml")
    }
    assert {name for name in needed if not (unpacked / name).is_file()} == set()
    assert [n for n in needed if (unpacked / n).read_bytes() != (ROOT / n).read_bytes()] == []
    assert not (unpacked / ".ci").exists()
    assert not (unpacked / "build").exists()


def test_sdist_gives_the_same_wheel(packages: Path, unpacked: Path, tmp_path: Path) -> None:
    """CMake finds all sources in it, and the wheel has the same files beside the kernels."""
    folders = ("-S", str(unpacked), "-B", str(tmp_path / "build"))
    variables = (f"-Dnanobind_DIR={nanobind.cmake_dir()}", f"-DPython_EXECUTABLE={sys.executable}")
    cmake = shutil.which("cmake", path=f"{Path(sys.executable).parent}:{os.environ['PATH']}")
    assert cmake is not None
    done = subprocess.run([cmake, *folders, *variables], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    build(unpacked, tmp_path / "dist", "--wheel", "-C", "wheel.cmake=false")
    (wheel,), (other,) = packages.glob("*.whl"), (tmp_path / "dist").glob("*.whl")
    packed = zipfile.ZipFile(wheel).namelist()
    assert {n for n in packed if not n.endswith(".so")} == set(zipfile.ZipFile(other).namelist())


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
