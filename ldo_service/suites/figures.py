"""Single figures of a judged run, by name."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

HELD_OUT, TRAINING = "A held out", "B training"


@dataclass(frozen=True, slots=True)
class Judged:
    """summary: summary.json of a run; results: what `ldo eval --json` printed of it."""

    summary: dict[str, Any]
    results: dict[str, Any]

    def trajectory(self, name: str) -> dict[str, Any]:
        return self.results["trajectory"][name]

    def rendering(self, protocol: str, figure: str, newest: bool = True) -> float | None:
        """Mean over frames; of the refined map where there is one, or of that of the stream."""
        rows = [row for row in self.results["rendering"] if row["protocol"] == protocol]
        return rows[-1 if newest else 0]["mean"][figure]

    def labels(self) -> dict[str, Any]:
        """Of the newest map: classes of COCO that have 0.2 % of the pixels, and background."""
        return self.results["labels"][-1]["lists"]["COCO"]["from 0.2 %"]

    def consistency(self) -> float | None:
        return self.results["labels"][-1]["consistency"]


@dataclass(frozen=True, slots=True)
class Figure:
    """`read` may find nothing (None, KeyError, IndexError, TypeError): then it is not judged."""

    title: str
    form: str
    read: Callable[[Judged], float | None]

    def of(self, judged: Judged) -> float | None:
        try:
            return self.read(judged)
        except (KeyError, IndexError, TypeError):
            return None


def _depth_l1_cm(run: Judged) -> float | None:
    depth_l1_m = run.rendering(HELD_OUT, "depth_l1_m")
    return None if depth_l1_m is None else 100 * depth_l1_m


def _seconds(stage: str) -> Callable[[Judged], float | None]:
    return lambda run: 1e-3 * run.summary["stage_ms"][stage]["p50"]


FIGURES: dict[str, Figure] = {
    "ate_cm": Figure(
        "ATE RMSE cm", ".2f", lambda run: 100 * run.trajectory("final")["ate_m"]["rmse"]
    ),
    "ate_mean_cm": Figure(
        "ATE mean cm", ".2f", lambda run: 100 * run.trajectory("final")["ate_m"]["mean"]
    ),
    "ate_online_cm": Figure(
        "ATE RMSE cm online", ".2f", lambda run: 100 * run.trajectory("online")["ate_m"]["rmse"]
    ),
    "psnr_db": Figure("PSNR dB", ".2f", lambda run: run.rendering(HELD_OUT, "psnr_db")),
    "psnr_online_db": Figure(
        "PSNR dB online", ".2f", lambda run: run.rendering(HELD_OUT, "psnr_db", newest=False)
    ),
    "psnr_training_db": Figure(
        "PSNR dB, training views", ".2f", lambda run: run.rendering(TRAINING, "psnr_db")
    ),
    "ssim": Figure("SSIM", ".3f", lambda run: run.rendering(HELD_OUT, "ssim")),
    "ssim_training": Figure(
        "SSIM, training views", ".3f", lambda run: run.rendering(TRAINING, "ssim")
    ),
    "depth_l1_cm": Figure("depth L1 cm", ".2f", _depth_l1_cm),
    "miou": Figure("mIoU %", ".1f", lambda run: 100 * run.labels()["mean_iou"]),
    "object_iou": Figure("object mIoU %", ".1f", lambda run: 100 * run.labels()["object_iou"]),
    "consistency": Figure("consistency", ".3f", lambda run: run.consistency()),
    "loop_precision": Figure("precision", ".3f", lambda run: run.results["loops"]["precision"]),
    "loop_recall": Figure("recall", ".3f", lambda run: run.results["loops"]["recall"]),
    "fps": Figure("FPS", ".2f", lambda run: run.summary["fps"]),
    "tracking_s": Figure("tracking s/frame", ".3f", _seconds("tracker")),
    "mapping_s": Figure("mapping s/keyframe", ".3f", _seconds("mapper")),
    "gaussians": Figure("Gaussians", ",.0f", lambda run: run.summary["gaussians"]),
    "optimizations": Figure("optimisations", ".0f", lambda run: run.summary["optimizations"]),
    "loops": Figure("closures", ".1f", lambda run: run.summary["loops_accepted"]),
}
