"""Resource usage and summary of a run."""

import os
import resource
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ldo_service import kernels, versions
from ldo_service.calibration import outlines
from ldo_service.calibration.correction import BIAS_COVARIANCE
from ldo_service.kernels.gpu.device import gpu_facts

from .folder import RunWriter

Percentiles = dict[str, float]  # Values of p50 and p95.
TIMES = "readout", "depth_readout", "depth_delay"  # Times of the shutter.
CALIBRATION = (  # Metrics of the tracker about the certainty of the camera's calibration.
    *("calibration_finished", "calibration_views", "frames_aligned", "frames_contradictory"),
    *("depth_bias_residual_ratio", "vignetting_residual_ratio"),
    *(f"{time}{kind}_ms" for time in TIMES for kind in ("", "_estimate", "_sigma")),
    *BIAS_COVARIANCE,
    *outlines.NAMES,
    *outlines.SIGMA_NAMES,
)


@dataclass(frozen=True, slots=True)
class Usage:
    """Elapsed time and CPU time of this process, seconds."""

    wall_s: float
    cpu_s: float

    @staticmethod
    def now() -> "Usage":
        return Usage(time.perf_counter(), time.process_time())

    def since(self, earlier: "Usage") -> "Usage":
        return replace(self, wall_s=self.wall_s - earlier.wall_s, cpu_s=self.cpu_s - earlier.cpu_s)

    def plus(self, other: "Usage") -> "Usage":
        return replace(self, wall_s=self.wall_s + other.wall_s, cpu_s=self.cpu_s + other.cpu_s)


def summarize(
    record: RunWriter,
    used: Usage,
    frames: int,
    rejected: int,
    stage_ms: dict[str, Percentiles],
    drops: dict[str, int],
    metrics: Mapping[str, Mapping[str, float]],
) -> dict[str, Any]:
    """Return the summary of a finished run.

    The frame rate (FPS) is the number of frames that were not rejected, divided by the time from
    the first read to the last step. After the last frame, the map is refitted to keyframes that
    corrections have moved; the time includes this refit.

    Args:
        record: The finished run.
        used: Time that the process has used for the run.
        frames: Number of selected frames.
        rejected: Number of frames that could not be used.
        stage_ms: Percentiles of the step durations of each actor.
        drops: Number of dropped messages by consumer and topic; each key is "ACTOR TOPIC".
        metrics: Metrics at the end, by actor.
    """
    names = [name for name in ("tracker", "optimizer", "mapper") if name in metrics]
    facts = {key: value for name in names for key, value in metrics[name].items()}
    in_map = record.in_map()
    return {
        "frames": frames,
        "frames_rejected": rejected,
        "status": record.statuses,
        "keyframes": record.keyframes,
        "gaussians": int(in_map.sum()),
        "gaussians_unmerged": int((~in_map).sum()),  # Unmerged submaps are in no file.
        "gaussians_labelled": record.labelled(),  # Gaussians not labelled background.
        "boxes": record.boxes,
        "objects": len(record.objects()),
        "fps": round((frames - rejected) / used.wall_s, 3) if used.wall_s > 0 else 0.0,
        "wall_s": round(used.wall_s, 3),
        "cpu_s": round(used.cpu_s, 3),
        "peak_rss_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 1),
        "stage_ms": stage_ms,
        "drops": drops,
        "loops_accepted": record.loops.accepted,
        "loops_rejected": record.loops.rejected,
        "labeller_requests": record.labeller_calls,
        "optimizations": int(facts.get("optimizations", 0)),
        # Keyframes at which landmark observations were not yet added to the pose graph.
        "optimizations_skipped": int(facts.get("optimizations_skipped", 0)),
        "iterations": int(facts.get("iterations", 0)),  # Iterations of the Gaussian optimizer.
        # Refit iterations still pending.
        "iterations_pending": int(facts.get("iterations_pending", 0)),
        # Evidence of the self-calibration at the end; empty if the tracker did not run.
        "calibration": {name: facts[name] for name in CALIBRATION if name in facts},
        "isa": kernels.isa(),
        **devices(metrics),
        "threads": os.cpu_count(),  # CPUs of the machine; a run may use fewer threads.
        "versions": versions(),
    }


def devices(metrics: Mapping[str, Mapping[str, float]]) -> dict[str, Any]:
    """Return the device of each actor that can use a GPU, and the GPU if any actor used it.

    A GPU that failed is named too, because it may have computed the first results.

    Args:
        metrics: Metrics at the end, by actor.
    """
    on_gpu = {name: bool(found["on_gpu"]) for name, found in metrics.items() if "on_gpu" in found}
    failed = sorted(name for name, found in metrics.items() if found.get("device_failed"))
    return {
        "devices": {name: "cuda" if on_gpu[name] else "cpu" for name in sorted(on_gpu)},
        "devices_failed": failed,
        "gpu": gpu_facts("cuda") if failed or any(on_gpu.values()) else {},
    }


def percentiles(values: list[float]) -> dict[str, float]:
    """Return the percentiles p50 and p95 of values."""
    return {
        "p50": round(float(np.percentile(values, 50)), 3),
        "p95": round(float(np.percentile(values, 95)), 3),
    }
