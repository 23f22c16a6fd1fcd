"""Agreement of the manual with the code."""

import re
from pathlib import Path

import pytest

from docs.generate import outputs
from ldo_service.errors import LdoError

ROOT = Path(__file__).parent.parent
MANUAL = tuple(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md")) + tuple(
    sorted((ROOT / "docs").rglob("*.md"))
)
DECISIONS = sorted((ROOT / "docs/decisions").glob("0*.md"))


def test_generated_files_are_current() -> None:
    for path, text in outputs():
        assert path.read_text() == text, f"{path.name}: run `python docs/generate.py`"


def test_every_type_of_a_field_is_defined_on_the_page_of_topics() -> None:
    page = (ROOT / "docs/topics.md").read_text()
    defined = set(re.findall(r"^### (\w+)$|^\| `([A-Z]\w*)` \|", page, re.MULTILINE))
    names = {name for pair in defined for name in pair if name} | {"Literal", "Array", "None"}
    for kind in re.findall(r"^\| `[a-z]\w*` \| `([^`]+)` \|", page, re.MULTILINE):
        assert set(re.findall(r"\b[A-Z]\w*", re.sub(r"'[^']*'", "", kind))) <= names, kind


def test_readme_has_at_most_200_lines() -> None:
    assert len((ROOT / "README.md").read_text().splitlines()) <= 200


@pytest.mark.parametrize("page", DECISIONS, ids=lambda page: page.stem)
def test_decision_record_has_its_form(page: Path) -> None:
    text = page.read_text()
    assert len(text.splitlines()) <= 20
    headings = re.findall(r"^#.*", text, re.MULTILINE)
    assert headings[0].startswith(f"# {page.stem[:4]}. ")
    assert headings[1:] == ["## Context", "## Decision", "## Consequence"]
    assert f"({page.name})" in (page.parent / "index.md").read_text()


@pytest.mark.parametrize("page", MANUAL, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_to_files_resolve(page: Path) -> None:
    for target in re.findall(r"\]\((?!http)([^)#]+)\)", page.read_text()):
        assert (page.parent / target).exists(), target


@pytest.mark.parametrize("error", LdoError.__subclasses__(), ids=lambda e: e.__name__)
def test_exit_codes_are_distinct(error: type[LdoError]) -> None:
    others = [other for other in LdoError.__subclasses__() if other is not error]
    assert all(error.exit_code != other.exit_code for other in others)
