"""Suite files, their runs, and the tables of scores."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import pytest

from ldo_service.batch import Recording
from ldo_service.config import load_config
from ldo_service.errors import ConfigError
from ldo_service.suites import (
    EvaluatedRun,
    Outcome,
    Suite,
    SuiteRun,
    SuiteRunner,
    known_suites,
    load_suite,
    markdown,
)
from ldo_service.suites.suite import FIGURES, HELD_OUT, TRAINING

SETTING = "mapper.iterations=2"
TWO = Suite(
    title="Two",
    sequences={"flat": "synthetic:flat", "desk": "tum/desk"},
    variants={"plain": (), "short": (SETTING,)},
    figures=("ate_cm", "fps"),
    seeds=(0, 3),
    published={"Other": {"desk": {"ate_cm": 4.26}}},
)


def suite_file(folder: Path, text: str) -> str:
    path = folder / "suite.yaml"
    path.write_text(text)
    return str(path)


def scores(ate_m: float, fps: float = 10.0) -> EvaluatedRun:
    trajectory = {"final": {"ate_m": {"rmse": ate_m}}}
    return EvaluatedRun({"fps": fps}, {"trajectory": trajectory, "rendering": []})


@pytest.mark.parametrize("name", known_suites())
def test_every_built_in_suite_is_valid(name: str) -> None:
    suite = load_suite(name)
    for settings in suite.variants.values():
        load_config(None, settings)
    for figures in [f for method in suite.published.values() for f in method.values()]:
        assert figures.keys() <= FIGURES.keys()
    assert set().union(*map(set, suite.published.values())) <= suite.sequences.keys()


def test_data_folders_run_once_and_synthetic_sources_once_per_seed() -> None:
    entries = list(TWO.entries(Path("/data")))
    assert [str(entry.folder) for entry in entries] == [
        *("flat/plain@0", "flat/plain@3", "flat/short@0", "flat/short@3"),
        *("desk/plain", "desk/short"),
    ]
    assert entries[3] == SuiteRun("flat", "short", "synthetic:flat@3", (SETTING,), 3)
    assert entries[4].source == "/data/tum/desk"


def test_other_variants_reuse_the_front_end_of_the_same_seed() -> None:
    shared = msgspec.structs.replace(TWO, front_end="plain", figures=("ate_cm",))
    first, again, other, other_again = list(shared.entries(Path()))[:4]
    assert (first.front_end_folder, again.front_end_folder) == (None, None)
    assert (other.front_end_folder, other_again.front_end_folder) == (first.folder, again.folder)
    assert {entry.front_end_folder for entry in TWO.entries(Path())} == {None}


def test_keys_differ_where_the_results_do(tmp_path: Path) -> None:
    def keys(suite: Suite, **options) -> list[str]:
        runner = SuiteRunner(suite, Path("/data"), tmp_path, **options)
        return [
            runner.job(entry, Recording(entry.source, entry.sequence, 0, entry.source)).key
            for entry in runner.entries()
        ]

    own = keys(TWO)
    shared = msgspec.structs.replace(TWO, front_end="plain", figures=("ate_cm",))
    assert len(set(own)) == len(own)
    assert set(keys(shared)).isdisjoint(own)
    assert keys(TWO, workers=2) == own
    assert set(keys(TWO, settings=("mapper.seed=5",))).isdisjoint(own)
    first, copy, other = (tmp_path / name for name in ("first", "copy", "other"))
    for path, content in ((first, "network"), (copy, "network"), (other, "another network")):
        path.write_text(content)
    with_lpips = keys(TWO, lpips=first)
    assert set(with_lpips).isdisjoint([*own, *keys(TWO, lpips=other)])
    assert keys(TWO, lpips=copy) == with_lpips, "the content of the network decides"


def test_invalid_setting_of_a_variant_is_refused_before_any_run(tmp_path: Path) -> None:
    wrong = msgspec.structs.replace(TWO, variants={"plain": (), "typo": ("mapper.iteration=2",)})
    runner = SuiteRunner(wrong, Path("/data"), tmp_path)
    with pytest.raises(ConfigError, match=r"mapper\.iterations"):
        next(runner.outcomes(lambda _: pytest.fail("a run has begun")))


def test_several_sequences_give_one_table_per_score() -> None:
    flat, again, short, short_again, desk, short_desk = TWO.entries(Path("/data"))
    outcomes = [
        Outcome(flat, scores(0.01)),
        Outcome(again, scores(0.03)),
        Outcome(short, scores(0.02)),
        Outcome(short_again, None, "failed"),
        Outcome(desk, scores(0.04)),
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


def test_single_sequence_gives_one_table_of_all_scores() -> None:
    one = Suite(
        title="One",
        about="Why.",
        sequences={"desk": "tum/desk"},
        figures=("ate_cm", "psnr_db"),
        published={"Other": {"desk": {"psnr_db": 20.0}}},
    )
    (entry,) = one.entries(Path())
    assert markdown(one, [Outcome(entry, scores(0.04))]).split("\n\n")[1:] == [
        "Why.",
        "| desk | ATE RMSE cm | PSNR dB |\n| --- | --- | --- |\n"
        "| Other |  | 20.00 |\n| LDO-SLAM | 4.00 | - |\n",
    ]


def test_table_names_the_variants_that_ran_without_a_detector() -> None:
    """A variant is named if one of its runs had neither a detector nor a labeller."""
    line = "short: without a detector and a labeller; the maps have no labels."

    def table(of_short: dict[str, str]) -> str:
        who = {"plain": {"detector": "demo", "labeller": ""}, "short": of_short}
        return markdown(
            TWO,
            [
                Outcome(e, replace(scores(0.01), results={"labelled_by": who[e.variant]}))
                for e in TWO.entries(Path())
            ],
        )

    assert table({"detector": "", "labeller": ""}).count(f"|\n\n{line}\n") == len(TWO.figures)
    assert "without a detector" not in table({"detector": "", "labeller": "demo"})


@pytest.mark.parametrize("sequences", [1, 2])
def test_lpips_has_no_column_without_its_network(sequences: int) -> None:
    line = "LPIPS is not computed; `--lpips FILE.onnx` adds it."
    names = ("ate_cm", "lpips", "lpips_training")
    suite = msgspec.structs.replace(
        TWO, sequences=dict(list(TWO.sequences.items())[:sequences]), figures=names
    )
    rows = [{"protocol": p, "mean": {"lpips": v}} for p, v in ((HELD_OUT, 0.2), (TRAINING, 0.125))]
    found = replace(scores(0.01), results={"trajectory": None, "rendering": rows})
    outcomes = [Outcome(entry, found) for entry in suite.entries(Path("/data"))]
    without, table = (markdown(suite, outcomes, has_lpips=known) for known in (False, True))
    assert without.count(line) == 1
    assert without.count("LPIPS") == 1, "no column and no table"
    assert "0.125" not in without
    assert line not in table
    assert "LPIPS, training views |" in table
    assert "0.125" in table
    assert "0.200" in table
    assert line not in markdown(TWO, [Outcome(e, found) for e in TWO.entries(Path())])


def test_semantic_scores_are_those_of_the_newest_map() -> None:
    def labels(value: float) -> dict[str, Any]:
        coco = {"from 0.2 %": {"mean_iou": value}, "instances": {"ap50": value / 2}}
        return {"consistency": value, "lists": {"COCO": coco}}

    found = EvaluatedRun({}, {"labels": [labels(0.25), labels(0.5)]})
    named = {name: FIGURES[name].of(found) for name in ("miou", "consistency", "ap50")}
    assert named == {"miou": 50, "consistency": 0.5, "ap50": 25}


@pytest.mark.parametrize("name", sorted(set(known_suites()) - {"loops"}))
def test_suites_have_all_semantic_columns_or_none(name: str) -> None:
    figures = set(load_suite(name).figures)
    assert {"miou", "consistency", "ap50"} & figures in ({"miou", "consistency", "ap50"}, set())
    assert ("psnr_db" in figures) == ("lpips" in figures)


@pytest.mark.parametrize("name", sorted(FIGURES))
def test_score_that_was_not_evaluated_is_none(name: str) -> None:
    assert FIGURES[name].of(EvaluatedRun({}, {"trajectory": None, "rendering": []})) is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"figures": ["beauty"]}, "unknown metric beauty. Known metrics: ate_cm"),
        ({"figures": []}, "at least one"),
        ({"variants": {"../up": []}}, "must be usable as a folder name"),
        ({"sequences": {"": "x"}}, "must be usable as a folder name"),
        ({"front_end": "default"}, "front_end='default' must be the first variant"),
        (
            {"front_end": "whole", "variants": {"whole": []}, "figures": ["miou", "fps"]},
            "fps depends on the tracker and detector",
        ),
        ({"sequnces": {}}, "is not a suite: .*sequnces"),
        ({"seeds": ["x"]}, "is not a suite: .*seeds"),
    ],
)
def test_invalid_suite_file_is_refused_with_the_reason(
    tmp_path: Path, change: dict[str, Any], message: str
) -> None:
    valid = {"title": "T", "sequences": {"a": "synthetic:room"}, "figures": ["fps"]}
    assert load_suite(suite_file(tmp_path, json.dumps(valid))).seeds == (0,)
    with pytest.raises(ConfigError, match=message):
        load_suite(suite_file(tmp_path, json.dumps(valid | change)))


def test_unknown_suite_name_lists_the_known_ones() -> None:
    with pytest.raises(ConfigError, match=r"there is no suite table-99\. .*table-1, table-2"):
        load_suite("table-99")


def test_invalid_yaml_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="is not a suite"):
        load_suite(suite_file(tmp_path, "title: ["))


def test_runs_with_different_seeds_have_different_folders() -> None:
    entry = next(TWO.entries(Path()))
    assert replace(entry, seed=1).folder != entry.folder
