"""Command `ldo info`: print what is in a data set or recording."""

import json
from dataclasses import asdict
from datetime import UTC, datetime
from typing import Annotated

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from ldo_service.config import load_config
from ldo_service.datasets import open_sequence
from ldo_service.errors import ConfigError, DataError
from ldo_service.geometry.sequence import Stream
from ldo_service.runs.source import layout_of
from ldo_service.runs.source_info import SourceInfo, describe, estimated_run_s

from .options import ConfigFile, Json, Settings, Source, Topics, argument, with_topics

MAX_UNUSED = 12  # Maximum number of unused streams in the table; --json lists all.
FIRST_UNIX_S = 946_684_800  # The year 2000. A smaller stamp is not a Unix time.
REGISTRATION = {
    "source": "registered to color in the source",
    "reader": "registered to color when a frame is read",
    "none": "not registered to color; set dataset.register_depth=true",
}


def info(
    source: Source,
    config: ConfigFile = None,
    set: Settings = (),
    topic: Topics = (),
    probe: Annotated[
        int, argument(metavar="N", help="run N frames to estimate the time of `ldo run`; 0: none")
    ] = 30,
    json_: Annotated[Json, argument(name="json")] = False,
) -> None:
    """Print what is in a source: streams, rate, gaps, calibration, depth and ground truth.

    The command reads all stamps and five of the frames. A gap is an interval between two frames
    that is longer than 1.5 times the median interval. To estimate the time of `ldo run` on this
    machine, the command runs the first 30 frames, which takes some seconds. --probe 0 skips this.

      ldo info ~/data/rgbd_dataset_freiburg1_desk
      ldo info desk.bag --probe 0
    """
    if probe < 0:
        raise ConfigError(f"--probe {probe} must be at least 0.")
    layout = layout_of(source)
    settings = load_config(config, with_topics(set, topic))
    sequence = open_sequence(source, settings.dataset.options())
    found = describe(sequence)
    run_s, why_none = None, "not estimated"
    if probe:
        try:
            run_s = estimated_run_s(sequence, settings, probe)
        except DataError as error:
            why_none = f"the run of {probe} frames failed: {error}"
    if json_:
        about = {"source": source, "layout": layout, "estimated_run_s": run_s}
        print(json.dumps({**about, **asdict(found)}, indent=1))
        return
    table = Table(title=escape(source), show_header=False)
    for name, value in _rows(layout, found).items():
        table.add_row(name, escape(value))
    estimate = why_none if run_s is None else f"about {run_s:.0f} s on this machine"
    table.add_row("time of `ldo run`", estimate)
    Console().print(table)


def _rows(layout: str, found: SourceInfo) -> dict[str, str]:
    timing, camera, depth = found.timing, found.camera, found.depth
    rate = f"{timing.rate_hz:.2f} Hz" if timing.rate_hz else "unknown"
    distortion = ", ".join(f"{k:g}" for k in camera["distortion"]) or "none"
    unreadable = (
        f"{found.unreadable_frames} of {found.sampled_frames} sampled frames: "
        f"{found.why_unreadable}"
    )
    return {
        "layout": layout,
        "frames": f"{timing.frames} in {timing.duration_s:.1f} s, at {rate}",
        "streams": _used(found.streams),
        **({"not used": unused} if (unused := _unused(found.streams)) else {}),
        "first stamp": _stamp(timing.first_stamp_s),
        "gaps": _gaps(found),
        "camera": f"{camera['width']}x{camera['height']}, fx {camera['fx']:g}, fy "
        f"{camera['fy']:g}, cx {camera['cx']:g}, cy {camera['cy']:g}",
        "distortion": distortion,
        "depth": REGISTRATION[depth.registration],
        "depth after color": _offset(found),
        "valid depth": "unknown"
        if depth.valid_ratio is None
        else f"{depth.valid_ratio:.1%} of the pixels, median {depth.median_m or 0:.2f} m",
        **({"unreadable": unreadable} if found.unreadable_frames else {}),
        "odometry": f"{found.odometry_poses} poses" if found.odometry_poses else "none",
        "ground truth": f"{found.true_poses} poses" if found.true_poses else "none",
        **({"true labels": "yes"} if found.has_true_labels else {}),
    }


def _used(streams: tuple[Stream, ...]) -> str:
    lines = [f"{stream.use}: {_text(stream)}" for stream in streams if stream.use]
    return "\n".join(lines) or "color and depth"


def _unused(streams: tuple[Stream, ...]) -> str:
    texts = [_text(stream) for stream in streams if not stream.use and stream.messages != 0]
    more = len(texts) - MAX_UNUSED
    return "\n".join(texts[:MAX_UNUSED] + ([f"and {more} more"] if more > 0 else []))


def _text(stream: Stream) -> str:
    count = "" if stream.messages is None else f", {stream.messages} messages"
    return f"{stream.name} ({stream.kind}{count})"


def _stamp(stamp_s: float) -> str:
    if stamp_s < FIRST_UNIX_S:
        return f"{stamp_s:.3f} s"
    return f"{stamp_s:.3f} s ({datetime.fromtimestamp(stamp_s, UTC):%Y-%m-%d %H:%M:%S} UTC)"


def _gaps(found: SourceInfo) -> str:
    timing = found.timing
    if not timing.gaps or timing.longest_interval_s is None:
        return "none"
    return f"{timing.gaps}, the longest of {timing.longest_interval_s:.3f} s"


def _offset(found: SourceInfo) -> str:
    depth = found.depth
    if depth.offset_ms is None or depth.max_offset_ms is None:
        return "one stamp for both"
    return f"{depth.offset_ms:.1f} ms (median), at most {depth.max_offset_ms:.1f} ms apart"
