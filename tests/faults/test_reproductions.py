"""The programs that show faults of commit 18f9264 do not find them."""

import logging
from collections.abc import Iterator

import pytest

from .reproductions import PROGRAMS, long_header


@pytest.fixture(autouse=True)
def without_log() -> Iterator[None]:
    logging.disable(logging.CRITICAL)
    yield
    logging.disable(logging.NOTSET)


@pytest.mark.slow
@pytest.mark.parametrize("program", PROGRAMS)
def test_fault_of_an_earlier_version_does_not_occur(program: str) -> None:
    assert not PROGRAMS[program]()


def test_program_finds_its_fault_if_headers_have_no_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ldo_service.runtime.mailbox.MAX_HEADER_BYTES", 10**9)
    assert long_header()
