"""Suite files, what they run, and the tables that come of it."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import pytest

from ldo_service.config import load_config
from ldo_service.errors import ConfigError
from ldo_service.suites import (
    Judged,
    Outcome,
    Suite,
    SuiteRun,
    SuiteRunner,
    known_suites,
    load_suite,
    markdown,
)
from ldo_service.suites.suite import FIGURES

SETTING = "mapper.iterations=2"
TWO = Suite(
    title="Two",
    sequences={"flat": "synthetic:flat", "desk": "tum/desk"},
    variants={"plain": (), "short": (SETTING,)},
    figures=("ate_cm", "fps"),
    seeds=(0, 3),
    published={"Other": {"desk": {"ate_cm": 4.26}}},
)


def written(folder: Path, text: str) -> str:
    path = folder / "suite.yaml"
    path.write_text(text)
    return str(path)


def judged(ate_m: float, fps: float = 10.0) -> Judged:
    trajectory = {"final": {"ate_m": {"rmse": ate_m}}}
    return Judged({"fps": fps}, {"trajectory": trajectory, "rendering": []})


@pytest.mark.parametrize("name", known_suites())
def test_every_suite_that_comes_with_it_can_be_run(name: str) -> None:
    suite = load_suite(name)
    for settings in suite.variants.values():
        load_config(None, settings)
    for figures in [f for method in suite.published.values() for f in method.values()]:
        assert figures.keys() <= FIGURES.keys()
    assert set().union(*map(set, suite.published.values())) <= suite.sequences.keys()


def test_folders_run_once_and_synthetic_sources_with_each_seed() -> None:
    entries = list(TWO.entries(Path("/data")))
    assert [str(entry.folder) for entry in entries] == [
        *("flat/plain@0", "flat/plain@3", "flat/short@0", "flat/short@3"),
        *("desk/plain", "desk/short"),
    ]
    assert entries[3] == SuiteRun("flat", "short", "synthetic:flat@3", (SETTING,), 3)
    assert entries[4].source == "/data/tum/desk"


def test_all_take_the_front_end_of_the_first_with_their_seed_where_one_is_named() -> None:
    shared = msgspec.structs.replace(TWO, front_end="plain", figures=("ate_cm",))
    first, again, other, other_again = list(shared.entries(Path()))[:4]
    assert (first.front_end_folder, again.front_end_folder) == (None, None)
    assert (other.front_end_folder, other_again.front_end_folder) == (first.folder, again.folder)
    assert {entry.front_end_folder for entry in TWO.entries(Path())} == {None}


def test_a_first_run_whose_front_end_is_gone_is_not_finished(tmp_path: Path) -> None:
    shared = msgspec.structs.replace(TWO, front_end="plain", figures=("ate_cm",))
    work = SuiteRunner(shared, Path("/data"), tmp_path)
    first, _, other, _ = work.entries()[:4]
    for entry in (first, other):
        (tmp_path / entry.folder).mkdir(parents=True)
        (tmp_path / entry.folder / "entry.json").write_text(work._told(entry))
    assert work._is_finished(other, tmp_path / other.folder)
    assert not work._is_finished(first, tmp_path / first.folder)
    (tmp_path / first.folder / "front_end.mcap").touch()
    assert work._is_finished(first, tmp_path / first.folder)


def test_each_figure_of_several_sequences_has_its_table() -> None:
    flat, again, short, short_again, desk, short_desk = TWO.entries(Path("/data"))
    outcomes = [
        Outcome(flat, judged(0.01)),
        Outcome(again, judged(0.03)),
        Outcome(short, judged(0.02)),
        Outcome(short_again, None, "failed"),
        Outcome(desk, judged(0.04)),
        Outcome(short_desk, None, "no data"),
    ]
    tables = markdown(TWO, outcomes).split("\n\n")
    assert tables[0] == "# Two"
    assert tables[1].splitlines() == [
        "| ATE RMSE cm | flat | desk | average |",
        "| --- | --- | --- | --- |",
        "| Other |  | 4.26 |  |",
        "| plain | 2.00 ± 1.41 | 4.00 | 3.00 |",
        "| short | 2.00 | no data | - |",
    ]
    assert tables[2].splitlines()[2:] == [
        "| plain | 10.00 ± 0.00 | 10.00 | 10.00 |",
        "| short | 10.00 | no data | - |",
    ]


def test_all_figures_of_one_sequence_are_one_table() -> None:
    one = Suite(
        title="One",
        about="Why.",
        sequences={"desk": "tum/desk"},
        figures=("ate_cm", "psnr_db"),
        published={"Other": {"desk": {"psnr_db": 20.0}}},
    )
    (entry,) = one.entries(Path())
    assert markdown(one, [Outcome(entry, judged(0.04))]).split("\n\n")[1:] == [
        "Why.",
        "| desk | ATE RMSE cm | PSNR dB |\n| --- | --- | --- |\n"
        "| Other |  | 20.00 |\n| LDO-SLAM | 4.00 | - |\n",
    ]


@pytest.mark.parametrize("name", sorted(FIGURES))
def test_a_figure_that_was_not_judged_is_none_and_no_error(name: str) -> None:
    assert FIGURES[name].of(Judged({}, {"trajectory": None, "rendering": []})) is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"figures": ["beauty"]}, "unknown figure beauty. Known: ate_cm"),
        ({"figures": []}, "at least one"),
        ({"variants": {"../up": []}}, "cannot be the name of a folder"),
        ({"sequences": {"": "x"}}, "cannot be the name of a folder"),
        ({"front_end": "default"}, "front_end is 'default': it must be the first variant"),
        (
            {"front_end": "whole", "variants": {"whole": []}, "figures": ["miou", "fps"]},
            "fps depends on the front end",
        ),
        ({"sequnces": {}}, "is not a suite: .*sequnces"),
        ({"seeds": ["x"]}, "is not a suite: .*seeds"),
    ],
)
def test_a_file_that_is_wrong_is_refused_with_the_reason(
    tmp_path: Path, change: dict[str, Any], message: str
) -> None:
    right = {"title": "T", "sequences": {"a": "synthetic:room"}, "figures": ["fps"]}
    assert load_suite(written(tmp_path, json.dumps(right))).seeds == (0,)
    with pytest.raises(ConfigError, match=message):
        load_suite(written(tmp_path, json.dumps(right | change)))


def test_a_name_that_is_no_suite_lists_those_that_are() -> None:
    with pytest.raises(ConfigError, match=r"there is no suite table-99: .*table-1, table-2"):
        load_suite("table-99")


def test_what_is_no_yaml_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="is not a suite"):
        load_suite(written(tmp_path, "title: ["))


def test_a_seed_of_another_run_is_another_folder() -> None:
    entry = next(TWO.entries(Path()))
    assert replace(entry, seed=1).folder != entry.folder
