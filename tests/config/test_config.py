"""Configuration from defaults, files and settings, and its errors."""

from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from ldo_service.config import (
    Config,
    actor_parameters,
    config_of,
    config_yaml,
    explained_yaml,
    load_config,
)
from ldo_service.config.printing import settings_of
from ldo_service.errors import ConfigError
from ldo_service.pose_graph.factors import NoiseConfig

CHANGED = (
    "tracker.hold_out=5",
    "service.process_actors=[mapper, optimizer]",
    "tracker.image.pyramid_levels=3",
    "paper.fusion_beta=3",
    "offline.latency_frames.mapper=7",
    "mapper.loss.max_sigma_px=.inf",
)


@pytest.mark.parametrize("settings", [(), CHANGED])
def test_printed_configuration_reads_back_as_equal(settings: tuple[str, ...]) -> None:
    config = load_config(settings=settings)
    for text in (
        config_yaml(config),
        explained_yaml(config),
        explained_yaml(config, with_advanced=True),
    ):
        assert config_of(yaml.safe_load(text)) == config


def test_default_print_has_public_and_changed_settings_only() -> None:
    settings = settings_of(Config())
    lines = explained_yaml(Config()).splitlines()
    printed = [line for line in lines if "  # " in line]
    assert len(printed) == sum(setting.is_public for setting in settings) == 66
    all_lines = explained_yaml(Config(), with_advanced=True).splitlines()
    assert len([line for line in all_lines if "  # " in line]) == len(settings)
    assert "pyramid_levels" not in explained_yaml(Config())
    assert "pyramid_levels: 3" in explained_yaml(load_config(settings=CHANGED))


def test_comment_is_printed_with_its_setting() -> None:
    lines = explained_yaml(Config(), with_advanced=True).splitlines()
    reasons = {key.strip(): reason for key, _, reason in (line.partition("  # ") for line in lines)}
    assert reasons["start_after_lost_frames: 90"].endswith("0 never starts one.")
    assert reasons["pyramid_levels: 4"].startswith("Number of pyramid levels. More levels")
    assert reasons["pyramid_levels: 4"].endswith("ends at 40 pixels.")


def test_settings_override_the_file(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("tracker:\n  hold_out: 5\nmapper:\n  threads: 3\n")
    config = load_config(path, ["mapper.threads=2"])
    assert (config.tracker.hold_out, config.mapper.threads) == (5, 2)


def test_preset_is_changed_by_the_file_and_by_settings(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text("paper: {ema_rule: corrected}\n")
    config = load_config(file, ["paper.label_region=foreground", "preset=paper"])
    assert config.paper.assignment_rule == "iou"
    assert config.paper.ema_rule == "corrected"
    assert config.paper.label_region == "foreground"
    assert load_config(file) == load_config(settings=["paper.ema_rule=corrected"])


def test_preset_paper_selects_the_rules_of_the_paper() -> None:
    paper, default = load_config(settings=["preset=paper"]), load_config()
    assert paper.paper == replace(
        default.paper,
        assignment_rule="iou",
        label_region="box",
        depth_test="one_sided",
        ema_rule="paper",
        ema_hold_back_ratio=0.0,
        observation_information_ratio=1.0,
    )
    assert not paper.mapper.open_vocabulary.detector_votes
    assert paper.loop_closer.retrieval.mode == "semantic"
    parameters = actor_parameters(paper)
    assert parameters.optimizer.graph.noise.independent_observations == 1.0
    assert parameters.mapper.semantics.labelling.assignment.depth_test == "one_sided"
    assert actor_parameters(default).optimizer.graph.noise == NoiseConfig()


def test_values_select_a_preset_and_change_it() -> None:
    config = load_config(values={"paper.label_region": "foreground", "preset": "paper"})
    wanted = load_config(settings=["preset=paper", "paper.label_region=foreground"])
    assert config == wanted
    assert config != load_config(settings=["paper.label_region=foreground"])


@pytest.mark.parametrize(
    ("settings", "values", "message"),
    [
        (["preset=papr"], {}, r"preset=papr must be the name of a preset\. Did you mean paper\?"),
        (["preset"], {}, r"preset= must be the name of a preset\. Known: paper\."),
        ([], {"preset": 7}, r"preset=7 must be the name of a preset\. Known: paper\."),
    ],
)
def test_unknown_preset_is_refused_with_the_known_ones(settings, values, message) -> None:
    with pytest.raises(ConfigError, match=message):
        load_config(settings=settings, values=values)


def test_preset_in_a_file_is_refused_with_the_option(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text("preset: paper\n")
    with pytest.raises(ConfigError, match=r"there is no setting preset\. .* use --preset NAME"):
        load_config(file)


def test_setting_one_latency_keeps_the_others(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("offline: {latency_frames: {detector: 9}}\n")
    latency = load_config(path).offline.latency_frames
    assert (latency.detector, latency.vlm_labeller) == (9, 30)


@pytest.mark.parametrize("written", ["2e-1", "2E-1", ".2e0", "+2.e-1", "0.2", "200e-3"])
def test_numbers_with_exponents_follow_yaml_1_2(written: str) -> None:
    config = load_config(settings=[f"supervision.heartbeat_s={written}"])
    assert config.supervision.heartbeat_s == 0.2


def test_name_that_looks_like_a_number_reads_back_as_text(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text('tracker:\n  localization_map: "1e5"\n')
    config = load_config(tmp_path / "mine.yaml")
    (tmp_path / "again.yaml").write_text(config_yaml(config))
    assert load_config(tmp_path / "again.yaml") == config
    assert config.tracker.localization_map == "1e5"


def test_an_empty_file_changes_nothing(tmp_path: Path) -> None:
    (tmp_path / "empty.yaml").write_text("")
    assert load_config(tmp_path / "empty.yaml") == Config()


@pytest.mark.parametrize(
    ("setting", "expected"),
    [
        (
            "tracker.holdout=5",
            "no setting tracker.holdout. Did you mean tracker.hold_out?",
        ),
        ("traker.hold_out=5", "Did you mean tracker?"),
        ("tracker.hold_out=1", "tracker.hold_out=1 must be 0 (maps every frame) or at least 2."),
        ("tracker.hold_out=many", "tracker.hold_out=many must be a whole number."),
        ("tracker.image.pyramid_levels=[", "not valid YAML"),
        ("hold_out=5", "section.field=value"),
        ("tracker.hold_out", "section.field=value"),
        ("tracker.hold_out.deeper=5", "tracker.hold_out={deeper: 5} must be a whole number."),
        ("mapper=3", "section.field=value"),
        ("tracker.image=3", "tracker.image=3 must be a section."),
        ("supervision.heartbeat_s=.nan", "supervision.heartbeat_s=nan must be a number"),
        ("service.shutdown_timeout_s=-1", "service.shutdown_timeout_s=-1 must be positive."),
        ("supervision.background_nice=20", "supervision.background_nice=20 must be at most 19."),
        (
            "service.remote_actors=[optimizer, tracker]",
            "must be one of 'detector', 'vlm_labeller', 'loop_closer', 'optimizer' in item 2.",
        ),
        ("paper.ema_rule=mine", "paper.ema_rule=mine must be one of 'corrected', 'paper'."),
        (
            "tracker.alignment.max_iterations=[8, 0]",
            "tracker.alignment.max_iterations=[8, 0] must be at least 1 in item 2.",
        ),
        ("detector.input_size_px=[640]", "detector.input_size_px=[640] must be a list of 2."),
        ("mapper.densify.max_cell_px=3", "mapper.densify.max_cell_px=3 must be a power of 2."),
        (
            "tracker.keyframes.min_interval_frames=31",
            "tracker.keyframes.min_interval_frames=31 must be at most "
            "tracker.keyframes.max_interval_frames=30.",
        ),
        (
            "tracker.T_base_camera.quaternion_wxyz=[1, 1, 0, 0]",
            "tracker.T_base_camera.quaternion_wxyz=[1.0, 1.0, 0.0, 0.0] must have norm 1",
        ),
        ("dataset.T_color_depth=[1, 0]", "dataset.T_color_depth=[1.0, 0.0] must be 16 numbers"),
        ("dataset.topics=[ir=/a]", "dataset.topics=['ir=/a'] must be a list whose entries are "),
    ],
)
def test_invalid_setting_is_refused_with_the_reason(setting: str, expected: str) -> None:
    with pytest.raises(ConfigError) as raised:
        load_config(settings=[setting])
    assert expected in str(raised.value)


def test_transform_that_is_not_rigid_is_refused() -> None:
    numbers = [2.0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
    config = load_config(settings=[f"dataset.T_color_depth={numbers}"])
    with pytest.raises(
        ConfigError, match=r"^dataset\.T_color_depth=\[2\.0, .* must be a rigid transform"
    ):
        config.dataset.options()


def test_invalid_file_is_refused_with_the_reason(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read"):
        load_config(tmp_path / "absent.yaml")
    for text, expected in (
        ("tracker: [", "not valid YAML"),
        ("- a\n- b\n", "must contain sections"),
    ):
        (tmp_path / "wrong.yaml").write_text(text)
        with pytest.raises(ConfigError, match=expected):
            load_config(tmp_path / "wrong.yaml")


@pytest.mark.parametrize(
    ("settings", "limit"),
    [
        (["deadline_s=595"], "supervision.backend_step_timeout_s=600"),
        (["deadline_s=30", "timeout_s=30"], "service.control_timeout_s=55"),
        (["deadline_s=48"], "service.control_timeout_s=55"),
    ],
)
def test_labeller_deadline_must_be_below_timeouts_of_the_service(
    settings: list[str], limit: str
) -> None:
    """Otherwise a slow server would stop the service; runs have no such limits."""
    endpoint = [f"vlm_labeller.http.{setting}" for setting in settings]
    load_config(settings=endpoint).check_timeouts()
    server = "vlm_labeller.url=http://127.0.0.1:8000/v1"
    config = load_config(settings=[server, *endpoint])
    with pytest.raises(ConfigError, match=f"the sum of .* must be below {limit}"):
        config.check_timeouts()
    load_config(settings=[server]).check_timeouts()
