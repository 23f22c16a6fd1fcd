"""Fuzz one target, or each in turn, guided by coverage: `pip install atheris`.

    python tests/fuzz/fuzz.py --list
    python tests/fuzz/fuzz.py PLY --minutes 5
    python tests/fuzz/fuzz.py all --minutes 1

Findings are written to build/fuzz/TARGET. `found-*` are bodies that raise an unexpected error, one
per place in the code. `crash-*`, `timeout-*` and `oom-*` come from libFuzzer. `--body FILE` tries a
finding again. Each finding becomes a test.
"""

import argparse
import gc
import logging
import subprocess
import sys
import tempfile
import traceback
import warnings
from hashlib import sha1
from pathlib import Path
from types import FunctionType

ROOT = Path(__file__).parent.parent.parent
OUT = ROOT / "build" / "fuzz"
LIMITS = ("-timeout=10", "-rss_limit_mb=3000", "-max_len=65536", "-print_final_stats=1")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("target", nargs="?", default="all")
    parser.add_argument("--minutes", type=float, default=1.0)
    parser.add_argument("--body", type=Path, help="try only this file")
    parser.add_argument("--list", action="store_true")
    arguments = parser.parse_args()
    sys.path.insert(0, str(ROOT))
    if arguments.target == "all" and not arguments.list:
        fuzz_all(arguments.minutes)
        return
    from tests.fuzz.targets import TARGETS

    if arguments.list:
        print("\n".join(TARGETS))
    elif arguments.target not in TARGETS:
        sys.exit(f"no target {arguments.target!r}; --list prints all targets.")
    elif arguments.body:
        with tempfile.TemporaryDirectory() as folder:
            TARGETS[arguments.target].attempt(arguments.body.read_bytes(), Path(folder))
    else:
        fuzz(TARGETS[arguments.target], arguments.minutes)


def fuzz_all(minutes: float) -> None:
    """Fuzz each target in its own process, because libFuzzer ends its process."""
    program = [sys.executable, __file__]
    names = subprocess.run([*program, "--list"], check=True, capture_output=True, text=True).stdout
    for name in names.splitlines():
        subprocess.run([*program, name, "--minutes", str(minutes)], check=False)


def fuzz(target, minutes: float) -> None:
    """Fuzz one target; libFuzzer ends the process, so the function does not return."""
    import atheris

    from tests.fuzz.mutation import WORDS

    for function in package_functions():
        atheris.instrument_func(function)
    logging.disable()
    warnings.simplefilter("ignore")
    name = "".join(c if c.isalnum() else "_" for c in target.name)
    out, corpus = OUT / name, OUT / name / "corpus"
    corpus.mkdir(parents=True, exist_ok=True)
    for number, seed in enumerate(target.seeds):
        (corpus / f"seed-{number}").write_bytes(seed)
    short = ("".join(f"\\x{byte:02x}" for byte in word) for word in WORDS if len(word) <= 64)
    (out / "words").write_text("".join(f'"{word}"\n' for word in short))
    folder, places = Path(tempfile.mkdtemp(prefix="ldo-fuzz-")), set[str]()

    def attempt(body: bytes) -> None:
        try:
            target.attempt(body, folder)
        except Exception as error:
            write_finding(error, body, out, places)

    sys.argv[1:] = [str(corpus), f"-artifact_prefix={out}/", f"-dict={out / 'words'}", *LIMITS]
    sys.argv.append(f"-max_total_time={round(60 * minutes)}")
    atheris.Setup(sys.argv, attempt)
    atheris.Fuzz()


def package_functions() -> list[FunctionType]:
    """Return the loaded functions of the package.

    Instrumentation at import has no effect on an editable install.
    """
    found = [one for one in gc.get_objects() if isinstance(one, FunctionType)]
    return [one for one in found if (one.__module__ or "").startswith("ldo_service")]


def write_finding(error: Exception, body: bytes, out: Path, places: set[str]) -> None:
    """Write the body, unless an earlier body raised this error at the same place in the code."""
    frame = traceback.extract_tb(error.__traceback__)[-1]
    place = f"{type(error).__name__} {frame.filename}:{frame.lineno}"
    if place in places:
        return
    places.add(place)
    path = out / f"found-{sha1(place.encode()).hexdigest()[:10]}"
    path.write_bytes(body)
    report = "".join(traceback.format_exception(error))
    path.with_suffix(".txt").write_text(f"{body[:200]!r}\n\n{report}")
    print(f"{path.name}: {place}: {error}", file=sys.stderr)


if __name__ == "__main__":
    main()
