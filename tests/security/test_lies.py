"""What comes from strangers is refused in a sentence, whatever it says of itself."""

import ast
from pathlib import Path

import pytest

from .attempt import Attempt
from .forged_messages import LIES

ROOT = Path(__file__).parent.parent.parent
RUNS_CODE = {"pickle", "cPickle", "dill", "cloudpickle", "marshal", "shelve", "joblib"}


@pytest.mark.parametrize("attempt", LIES, ids=str)
def test_a_lie_comes_to_what_it_must(attempt: Attempt[Path], tmp_path: Path) -> None:
    assert attempt.try_it(tmp_path) == attempt.expected


def ours() -> list[Path]:
    folders = ("ldo_service", "actors", "schemas", "examples")
    return [path for folder in folders for path in sorted((ROOT / folder).rglob("*.py"))]


def dangers(source: str) -> list[str]:
    """What in a program would run what a file says."""
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
            case ast.Call(ast.Attribute(attr="load", value=ast.Name("np")), keywords=said):
                forbids = [k for k in said if k.arg == "allow_pickle"]
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
def test_what_would_run_a_file_is_found(source: str) -> None:
    assert len(dangers(source)) == 1


def test_nothing_of_ours_runs_what_a_file_says() -> None:
    found = {str(path): dangers(path.read_text()) for path in ours()}
    assert len(found) > 100
    assert {path: what for path, what in found.items() if what} == {}
