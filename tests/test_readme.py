"""Agreement of the manual with the code."""

import re
from pathlib import Path

import pytest

from docs.generate import PAGES, generated
from ldo_service.errors import LdoError

ROOT = Path(__file__).parent.parent
MANUAL = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_generated_parts_of_docs_are_up_to_date(page: Path) -> None:
    assert page.read_text() == generated(page.read_text()), "run `python docs/generate.py`"


@pytest.mark.parametrize("page", MANUAL, ids=lambda page: page.name)
def test_links_to_files_resolve(page: Path) -> None:
    for target in re.findall(r"\]\((?!http)([^)#]+)\)", page.read_text()):
        assert (page.parent / target).exists(), target


@pytest.mark.parametrize("error", LdoError.__subclasses__(), ids=lambda e: e.__name__)
def test_exit_codes_are_distinct(error: type[LdoError]) -> None:
    others = [other for other in LdoError.__subclasses__() if other is not error]
    assert all(error.exit_code != other.exit_code for other in others)
