"""Job of a batch for one recording, and the outcome of this job."""

import hashlib
import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import msgspec

from ldo_service import __version__
from ldo_service.config import Config, config_yaml
from ldo_service.detection.model_registry import Models
from ldo_service.detection.onnx_network import sha256
from ldo_service.errors import ConfigError
from ldo_service.runs.export import ExportFormat
from ldo_service.runs.job import require_held_out
from ldo_service.runs.source import Selection

from .sources import Recording

FORMAT = 1  # Increased if results of older versions of `ldo batch` cannot be kept.
KEY_DIGITS = 12  # Hexadecimal digits of the key in the name of a folder.


class RunPlan(msgspec.Struct, frozen=True, kw_only=True):
    """Settings of the work that are the same for all recordings of a batch.

    Attributes:
        config: Configuration of the runs.
        stride: N, where every N-th frame is used.
        max_frames: Maximum number of frames; None for all.
        refine: Number of iterations of the Gaussian optimizer after the last frame.
        exports: Formats of `ldo export`.
        threads: Threads of one process; 0 for all cores.
        evaluates_all: True to evaluate the renderings of every recording in full. False to limit
            recordings without ground truth to a few rendered frames.
        lpips: Path of the network that computes LPIPS; empty to omit LPIPS.

    Raises:
        ConfigError: An option is out of its range, or two options exclude each other.
    """

    config: Config
    stride: int = 1
    max_frames: int | None = None
    refine: int = 0
    exports: tuple[ExportFormat, ...] = ()
    threads: int = 1
    evaluates_all: bool = False
    lpips: str = ""

    def __post_init__(self) -> None:
        if self.threads < 0:
            raise ConfigError(
                f"--threads {self.threads} must not be negative. Use 0 for all cores."
            )
        if self.refine < 0:
            raise ConfigError(
                f"--refine-iterations {self.refine} must not be negative. Use 0 for no refinement."
            )
        Selection(self.stride, self.max_frames)
        require_held_out(self.stride, self.config.tracker.hold_out)


class BatchJob(msgspec.Struct, frozen=True, kw_only=True):
    """Everything that a process needs to know to process one recording.

    Attributes:
        recording: The recording.
        plan: Settings of the work.
        out: Path or address of the folder with all results.
        folder: Folder of this result, relative to `out`.
        key: Digest of the content of the source and of everything that the results depend on.
        keeps_front_end: True to record the outputs of the tracker and the detector.
        front_end: Folder of an earlier run, relative to `out`. Its recorded outputs replace frame
            source, tracker and detector. Empty to run these actors.
        staging: Temporary folder for copies of recordings and for unfinished results.
        max_staged_bytes: Maximum total size of the copies of recordings on one machine, bytes.
        repeats: True to replace finished results.
        version: Version of LDO-SLAM that must process the recording.
    """

    recording: Recording
    plan: RunPlan
    out: str
    folder: str
    key: str
    keeps_front_end: bool = False
    front_end: str = ""
    staging: str
    max_staged_bytes: int = 0
    repeats: bool = False
    version: str = __version__


class Costs(msgspec.Struct, frozen=True, kw_only=True):
    """Resources that the process of one job used to run and evaluate its recording."""

    wall_s: float  # Wall time until the results are published.
    cpu_s: float  # CPU time of all threads of the process, including its start.
    run_cpu_s: float  # CPU time of SLAM alone, a part of `cpu_s`.
    evaluation_cpu_s: float  # CPU time of the evaluation, a part of `cpu_s`.
    peak_rss_mb: float  # Largest resident memory of the process.
    source_bytes: int  # Size of the recording.
    result_bytes: int  # Size of the results.
    recording_s: float  # Duration of the recording, from the first to the last used frame.
    host: str  # Name of the machine.


class Outcome(msgspec.Struct, frozen=True, kw_only=True):
    """Outcome of one recording of a batch.

    Attributes:
        source: Path or address of the recording.
        name: Name of the recording.
        folder: Folder of the result, relative to the folder of all results.
        status: "done" if this call made the results, and "kept" if an earlier call made them.
            "failed" if the recording could not be read or processed, and "missing" if the batch was
            interrupted before the recording was processed.
            "duplicate" if another source has the same name and content.
        error: Reason why there are no results, on one line; empty if there are results.
        notes: Warnings of the run and of its evaluation.
        digest: Digest of all results that do not depend on timing; see `results.digest_of`.
        summary: Counts and scores for the table.
        costs: Resources that were used; None if there are no results.
        pictures: File names of pictures in the folder.
    """

    source: str
    name: str
    folder: str
    status: str
    error: str = ""
    notes: tuple[str, ...] = ()
    digest: str = ""
    summary: dict[str, Any] = {}
    costs: Costs | None = None
    pictures: tuple[str, ...] = ()

    @property
    def has_results(self) -> bool:
        """True if the folder contains finished results."""
        return self.status in ("done", "kept")


def failed(job: BatchJob, error: str, status: str = "failed") -> Outcome:
    """Return the outcome of a recording without results.

    Args:
        job: Job of the recording.
        error: Reason why there are no results. Its line breaks are replaced by spaces.
        status: "failed" or "missing".
    """
    return Outcome(
        source=job.recording.source,
        name=job.recording.name,
        folder=job.folder,
        status=status,
        error=" ".join(error.split()),
    )


def key_of(recording: Recording, plan: RunPlan, **others: Any) -> str:
    """Return a hexadecimal digest of everything that the results of a recording depend on.

    The digest covers the content of the recording, the configuration, the files of the networks,
    the options of the plan except its number of threads, and the version of LDO-SLAM. It does not
    cover the path of the recording.

    Args:
        recording: The recording.
        plan: Settings of the work.
        others: Further values that the results depend on.
    """
    config = plan.config
    about = {
        "format": FORMAT,
        "content": recording.content,
        "config": config_yaml(replace(config, mapper=replace(config.mapper, threads=0))),
        "networks": [_network(name) for name in (config.detector.model, config.vlm_labeller.model)],
        "stride": plan.stride,
        "max_frames": plan.max_frames,
        "refine": plan.refine,
        "exports": sorted(plan.exports),
        "evaluates_all": plan.evaluates_all,
        "ldo": __version__,
        **others,
    }
    if plan.lpips:
        about["lpips"] = sha256(Path(plan.lpips))
    return hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()


@cache
def _network(model: str) -> str:
    """Return the digest of the files of a network, or its name if there are no files."""
    models = Models()
    path = models.folder / model if model in models.names else Path(model).expanduser()
    if not model or not path.exists():
        return model
    files = [path] if path.is_file() else sorted(p for p in path.rglob("*") if p.is_file())
    return hashlib.sha256("".join(map(sha256, files)).encode()).hexdigest()
