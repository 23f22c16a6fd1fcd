"""Table of attacks on the service, with the expected and the observed result.

    python -m tests.bench.bench_security

The attempts are those of the tests in `tests/security`.
"""

import sys
import tempfile
from pathlib import Path

from tests.security.attack_cases import ATTEMPTS
from tests.security.attempt import Attempt, Where
from tests.security.forged_messages import LIES
from tests.security.network_fixture import lab


def row(attempt: Attempt[Where], where: Where) -> bool:
    seen = attempt.try_it(where)
    is_as_expected = seen == attempt.expected
    mark = "" if is_as_expected else " **not as expected**"
    print(f"| {attempt.name} | {attempt.expected} | {seen}{mark} |", flush=True)
    return is_as_expected


def main() -> None:
    print("| attempt | expected | observed |\n|---|---|---|")
    results = []
    with tempfile.TemporaryDirectory() as folder:
        with lab(Path(folder) / "keys") as here:
            results += [row(attempt, here) for attempt in ATTEMPTS]
        for number, lie in enumerate(LIES):
            own = Path(folder) / str(number)
            own.mkdir()
            results.append(row(lie, own))
    print(f"\n{sum(results)} of {len(results)} as expected")
    sys.exit(0 if all(results) else 1)


if __name__ == "__main__":
    main()
