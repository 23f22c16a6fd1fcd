"""Fixture that runs kernels in separate processes, once per instruction set of this machine."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

Arrays = dict[str, np.ndarray]
PROGRAM = """
import sys, numpy as np
given = dict(np.load(sys.argv[1]))
result = {}
exec(sys.argv[3])
np.savez(sys.argv[2], **result)
"""


@pytest.fixture(scope="module", params=("baseline", "avx2", "avx512"))
def with_isa(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Callable[[str, Arrays], Arrays]:
    """Return a function that runs Python lines, which fill `result` from `given`."""

    def run(body: str, given: Arrays) -> Arrays:
        folder: Path = tmp_path_factory.mktemp(request.param)
        np.savez(folder / "given.npz", **given)
        done = subprocess.run(
            [sys.executable, "-c", PROGRAM, "given.npz", "result.npz", body],
            env=os.environ | {"LDO_ISA": request.param},
            cwd=folder,
            capture_output=True,
            text=True,
        )
        if "no such instructions" in done.stderr:
            pytest.skip(f"this machine has no {request.param}")
        assert done.returncode == 0, done.stderr
        return dict(np.load(folder / "result.npz"))

    return run
