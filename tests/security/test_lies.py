"""Tests that forged files are rejected with an error and that no code of a file is run."""

import ast
from pathlib import Path

import pytest

from .attempt import Attempt
from .forged_messages import LIES

ROOT = Path(__file__).parent.parent.parent
RUNS_CODE = {"pickle", "cPickle", "dill", "cloudpickle", "marshal", "shelve", "joblib"}


@pytest.mark.parametrize("attempt", LIES, ids=str)
def test_forged_file_or_name_is_rejected_as_expected(
    attempt: Attempt[Path], tmp_path: Path
) -> None:
    assert attempt.try_it(tmp_path) == attempt.expected


def package_files() -> list[Path]:
    folders = ("ldo_service", "actors", "schemas", "examples")
    return [path for folder in folders for path in sorted((ROOT / folder).rglob("*.py"))]


def unsafe_calls(source: str) -> list[str]:
    """Return the calls and imports in a program that could run code from a file."""
    found = []
    for node in ast.walk(ast.parse(source)):
        match node:
            case ast.Import(names):
                found += [one.name for one in names if one.name.split(".")[0] in RUNS_CODE]
            case ast.ImportFrom(module=str(module)) if module.split(".")[0] in RUNS_CODE:
                found.append(module)
            case ast.Call(ast.Name("eval" | "exec") as called):
                found.append(called.id)
            case ast.Call(ast.Attribute(attr="load" | "load_all", value=ast.Name("yaml"))):
                found.append("yaml.load")
            case ast.Call(ast.Attribute(attr="extractall" | "unsafe_load")):
                found.append("extractall")
            case ast.Call(ast.Attribute(attr="load", value=ast.Name("np")), keywords=keywords):
                forbids = [k for k in keywords if k.arg == "allow_pickle"]
                if not forbids or getattr(forbids[0].value, "value", None) is not False:
                    found.append("np.load that may unpickle")
            case ast.keyword("shell", ast.Constant(True)):
                found.append("shell=True")
    return found


@pytest.mark.parametrize(
    "source",
    [
        "import pickle",
        "from dill import loads",
        "eval('1')",
        "yaml.load(file)",
        "np.load(path)",
        "np.load(path, allow_pickle=True)",
        "archive.extractall()",
        "subprocess.run('x', shell=True)",
    ],
)
def test_unsafe_call_is_detected(source: str) -> None:
    assert len(unsafe_calls(source)) == 1


def test_package_has_no_unsafe_call() -> None:
    found = {str(path): unsafe_calls(path.read_text()) for path in package_files()}
    assert len(found) > 100
    assert {path: what for path, what in found.items() if what} == {}
