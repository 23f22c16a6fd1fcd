"""The manual says what the code says."""

import re
from pathlib import Path

import pytest

from ldo_service.actors.graph import drawing, topics_table
from ldo_service.errors import LdoError

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()


def test_the_table_and_the_drawing_are_those_of_the_graph() -> None:
    assert topics_table() in README, "paste `ldo topics --markdown`"
    assert drawing() in README, "paste `ldo topics --mermaid`"


def test_every_link_to_a_file_leads_somewhere() -> None:
    for target in re.findall(r"\]\((?!http)([^)#]+)\)", README):
        assert (ROOT / target).exists(), target


@pytest.mark.parametrize("error", LdoError.__subclasses__(), ids=lambda e: e.__name__)
def test_exit_codes_are_distinct(error: type[LdoError]) -> None:
    others = [other for other in LdoError.__subclasses__() if other is not error]
    assert all(error.exit_code != other.exit_code for other in others)
