"""Tests of the tables of attempts in the page on faults."""

from .attempts import PAGE, attempts, files_of_tests, verdict


def test_each_attempt_of_the_page_names_tests_that_exist() -> None:
    table, files = attempts(PAGE.read_text()), files_of_tests()
    assert len(table) > 50
    assert [attempt for attempt, names in table.items() if not names] == []
    assert {name for names in table.values() for name in names} - set(files) == set()


def test_attempt_is_seen_if_one_of_its_tests_fails() -> None:
    assert verdict([{"passed"}, {"passed"}]) == "NOT SEEN"
    assert verdict([{"passed"}, {"passed", "failed"}]) == "SEEN"
    assert verdict([{"passed"}, {"skipped"}]) == "SKIPPED"
    assert verdict([{"passed"}, set()]) == "SKIPPED"
