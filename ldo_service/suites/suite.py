"""Suite files: the runs that they list and the metrics that they compare."""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import yaml
from msgspec import field

from ldo_service.errors import ConfigError
from ldo_service.storage.yaml_io import load_yaml

# Names of the rendering protocols in the output of `ldo eval --json`.
HELD_OUT, TRAINING = "A held out", "B training"

HERE = Path(__file__).parent
SYNTHETIC = "synthetic:"
# Metrics that depend on the front end: tracker and detector.
OF_FRONT_END = frozenset({"fps", "tracking_s", "ate_online_cm"})
OF_LPIPS = frozenset({"lpips", "lpips_training"})  # Metrics that need a network of LPIPS.
NAME = re.compile(r"[\w][\w .+-]{0,60}")  # Valid names of folders.


@dataclass(frozen=True, slots=True)
class EvaluatedRun:
    """Results of a run.

    Attributes:
        summary: Content of summary.json.
        results: Output of `ldo eval --json`.
    """

    summary: dict[str, Any]
    results: dict[str, Any]

    def trajectory(self, name: str) -> dict[str, Any]:
        """Return the errors of a trajectory, such as "online" or "final"."""
        return self.results["trajectory"][name]

    def rendering(self, protocol: str, figure: str, newest: bool = True) -> float | None:
        """Return the mean of a rendering metric over all frames.

        Args:
            protocol: Protocol of the evaluation, HELD_OUT or TRAINING.
            figure: Name of the metric.
            newest: True to use the refined map if there is one; False to use the map at the end of
                the stream.

        Returns:
            The mean in the unit of the metric; None if the metric has no value.
        """
        rows = [row for row in self.results["rendering"] if row["protocol"] == protocol]
        return rows[-1 if newest else 0]["mean"][figure]

    def labels(self) -> dict[str, Any]:
        """Return the label metrics of the newest map.

        The metrics cover background and the COCO classes with at least 0.2 % of the pixels.
        """
        return self.results["labels"][-1]["lists"]["COCO"]["from 0.2 %"]

    @property
    def is_labelled(self) -> bool:
        """True if a detector or a labeller ran, or if the results do not state it."""
        who = self.results.get("labelled_by")
        return who is None or any(who.values())

    def ap50(self) -> float:
        """Return the AP50 of the objects of the newest map, 0..1, over the COCO classes."""
        return self.results["labels"][-1]["lists"]["COCO"]["instances"]["ap50"]

    def consistency(self) -> float | None:
        """Return the fraction of object pixels with equal labels in two views of the newest map.

        The value is None if no pixel was compared.
        """
        return self.results["labels"][-1]["consistency"]


@dataclass(frozen=True, slots=True)
class Score:
    """Metric that a table of results shows.

    Attributes:
        title: Title of the column.
        form: Format specification of the value, such as ".2f".
        read: Function that returns the metric of a run. For a run without this metric, the function
            returns None or raises KeyError, IndexError or TypeError.
    """

    title: str
    form: str
    read: Callable[[EvaluatedRun], float | None]

    def of(self, evaluated: EvaluatedRun) -> float | None:
        """Return the metric of a run; None if the run lacks this metric."""
        try:
            return self.read(evaluated)
        except (KeyError, IndexError, TypeError):
            return None


def _depth_l1_cm(run: EvaluatedRun) -> float | None:
    depth_l1_m = run.rendering(HELD_OUT, "depth_l1_m")
    return None if depth_l1_m is None else 100 * depth_l1_m


def _seconds(stage: str) -> Callable[[EvaluatedRun], float | None]:
    return lambda run: 1e-3 * run.summary["stage_ms"][stage]["p50"]


FIGURES: dict[str, Score] = {
    "ate_cm": Score(
        "ATE RMSE cm", ".2f", lambda run: 100 * run.trajectory("final")["ate_m"]["rmse"]
    ),
    "ate_mean_cm": Score(
        "ATE mean cm", ".2f", lambda run: 100 * run.trajectory("final")["ate_m"]["mean"]
    ),
    "ate_online_cm": Score(
        "ATE RMSE cm online", ".2f", lambda run: 100 * run.trajectory("online")["ate_m"]["rmse"]
    ),
    "psnr_db": Score("PSNR dB", ".2f", lambda run: run.rendering(HELD_OUT, "psnr_db")),
    "psnr_online_db": Score(
        "PSNR dB online", ".2f", lambda run: run.rendering(HELD_OUT, "psnr_db", newest=False)
    ),
    "psnr_training_db": Score(
        "PSNR dB, training views", ".2f", lambda run: run.rendering(TRAINING, "psnr_db")
    ),
    "ssim": Score("SSIM", ".3f", lambda run: run.rendering(HELD_OUT, "ssim")),
    "ssim_training": Score(
        "SSIM, training views", ".3f", lambda run: run.rendering(TRAINING, "ssim")
    ),
    "lpips": Score("LPIPS", ".3f", lambda run: run.rendering(HELD_OUT, "lpips")),
    "lpips_training": Score(
        "LPIPS, training views", ".3f", lambda run: run.rendering(TRAINING, "lpips")
    ),
    "depth_l1_cm": Score("depth L1 cm", ".2f", _depth_l1_cm),
    "miou": Score("mIoU %", ".1f", lambda run: 100 * run.labels()["mean_iou"]),
    "object_iou": Score("object mIoU %", ".1f", lambda run: 100 * run.labels()["object_iou"]),
    "consistency": Score("consistency", ".3f", lambda run: run.consistency()),
    "ap50": Score("AP50 %", ".1f", lambda run: 100 * run.ap50()),
    "loop_precision": Score("precision", ".3f", lambda run: run.results["loops"]["precision"]),
    "loop_recall": Score("recall", ".3f", lambda run: run.results["loops"]["recall"]),
    "fps": Score("FPS", ".2f", lambda run: run.summary["fps"]),
    "tracking_s": Score("tracking s/frame", ".3f", _seconds("tracker")),
    "mapping_s": Score("mapping s/keyframe", ".3f", _seconds("mapper")),
    "gaussians": Score("Gaussians", ",.0f", lambda run: run.summary["gaussians"]),
    "optimizations": Score("optimizations", ".0f", lambda run: run.summary["optimizations"]),
    "loops": Score("closures", ".1f", lambda run: run.summary["loops_accepted"]),
}


@dataclass(frozen=True, slots=True)
class SuiteRun:
    """One run of a suite: one variant of the settings on one sequence."""

    sequence: str
    variant: str
    source: str
    settings: tuple[str, ...]
    seed: int | None  # Seed of a synthetic source, else None.
    # Variant whose recorded front end (outputs of tracker and detector) the run reuses; None if the
    # run makes its own.
    front_end: str | None = None

    @property
    def folder(self) -> Path:
        """Folder of this run, relative to the result folder of the suite."""
        return self._folder_of(self.variant)

    @property
    def front_end_folder(self) -> Path | None:
        """Folder of the run whose tracker and detector outputs this run reuses, or None."""
        return self._folder_of(self.front_end) if self.front_end else None

    def _folder_of(self, variant: str) -> Path:
        seed = "" if self.seed is None else f"@{self.seed}"
        return Path(self.sequence) / f"{variant}{seed}"


class Suite(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Content of a suite file.

    Raises:
        ConfigError: A required list is empty, a sequence or variant name cannot be a folder name, a
            metric is unknown, or `front_end` is invalid.
    """

    title: str  # Title of the tables.
    about: str = ""  # Text below the title.
    # Source by name of the sequence: a folder within the data folder, or synthetic:...
    sequences: dict[str, str]
    # Settings by name of the variant, as for `ldo run --set`.
    variants: dict[str, tuple[str, ...]] = field(default_factory=lambda: {"LDO-SLAM": ()})
    figures: tuple[str, ...]  # Names of the metrics in the tables, from FIGURES.
    # Name of the first variant, if this variant alone runs the front end. The other variants reuse
    # the recorded outputs of its tracker and detector, so that all poses are equal. None: each
    # variant runs its own front end.
    front_end: str | None = None
    # Seeds of synthetic sources. A data set needs no seed, because all its runs are identical.
    seeds: tuple[int, ...] = (0,)
    # Options of `ldo run`: --hold-out-every, --refine-iterations, --stride and --max-frames.
    hold_out: int = 0
    refine: int = 0
    stride: int = 1
    max_frames: int | None = None  # `None` uses all frames.
    # Published values for comparison: the number by method, then sequence, then metric.
    published: dict[str, dict[str, dict[str, float]]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.sequences or not self.variants or not self.figures or not self.seeds:
            raise ConfigError(
                "sequences, variants, figures and seeds must each have at least one entry."
            )
        for name in (*self.sequences, *self.variants):
            if not NAME.fullmatch(name):
                raise ConfigError(
                    f"the sequence or variant name {name!r} must be usable as a folder name. Use "
                    "letters, digits, spaces and the characters . _ + -"
                )
        if self.front_end not in (None, next(iter(self.variants))):
            raise ConfigError(
                f"front_end={self.front_end!r} must be the first variant, "
                f"{next(iter(self.variants))!r}."
            )
        unknown = sorted(set(self.figures) - FIGURES.keys())
        if unknown:
            raise ConfigError(
                f"figures has the unknown metric {', '.join(unknown)}. Known metrics: "
                f"{', '.join(FIGURES)}."
            )
        of_front_end = sorted(OF_FRONT_END.intersection(self.figures))
        if self.front_end and of_front_end:
            raise ConfigError(
                f"{of_front_end[0]} depends on the tracker and detector, whose outputs all "
                f"variants reuse from {self.front_end!r}. Remove {of_front_end[0]} from figures, "
                "or remove front_end."
            )

    def entries(self, data: Path) -> Iterator[SuiteRun]:
        """Yield all runs, ordered by sequence.

        Args:
            data: Folder with the data sets.
        """
        for sequence, source in self.sequences.items():
            for variant, settings in self.variants.items():
                front_end = None if variant == self.front_end else self.front_end
                if not source.startswith(SYNTHETIC):
                    where = str(data / source)
                    yield SuiteRun(sequence, variant, where, settings, None, front_end)
                    continue
                for seed in self.seeds:
                    where = f"{source}@{seed}"
                    yield SuiteRun(sequence, variant, where, settings, seed, front_end)

    def front_end_settings(self) -> tuple[str, ...] | None:
        """Return the settings of the variant named by `front_end`; None if `front_end` is None."""
        return None if self.front_end is None else self.variants[self.front_end]

    def options(self) -> list[str]:
        """Return the options of `ldo run` that all runs share."""
        words = [
            "--hold-out-every",
            self.hold_out,
            "--refine-iterations",
            self.refine,
            "--stride",
            self.stride,
        ]
        if self.max_frames is not None:
            words += ["--max-frames", self.max_frames]
        return [str(word) for word in words]


def known_suites() -> list[str]:
    """Return the names of the built-in suites."""
    return sorted(path.stem for path in HERE.glob("*.yaml"))


def load_suite(name: str) -> Suite:
    """Return a built-in suite or the suite in a file.

    Raises:
        ConfigError: There is no such suite, or the file is invalid.
    """
    path = HERE / f"{name}.yaml" if name in known_suites() else Path(name).expanduser()
    if not path.is_file():
        raise ConfigError(
            f"there is no suite {name}. Give a YAML file or one of {', '.join(known_suites())}."
        )
    try:
        return msgspec.convert(load_yaml(path.read_text()), Suite)
    except ConfigError as error:
        raise ConfigError(f"{path} is not a suite: {error}") from error
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise ConfigError(f"{path} is not a suite: {error}. Correct the file.") from error
