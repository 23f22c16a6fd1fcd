"""Tests of access control over TLS: each role can do what it is made for, and nothing else."""

from collections.abc import Iterator

import pytest

from .attack_cases import ATTEMPTS, Attempt
from .network_fixture import Lab, lab


@pytest.fixture(scope="module")
def here(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    with lab(tmp_path_factory.mktemp("network") / "keys") as here:
        yield here


@pytest.mark.parametrize("attempt", ATTEMPTS, ids=lambda attempt: attempt.name)
def test_attempt_has_the_expected_result(attempt: Attempt, here: Lab) -> None:
    assert attempt.try_it(here) == attempt.expected
