"""Real-time run over a sequence: frames arrive at the times of their stamps and may be dropped."""

import asyncio
import time
from collections.abc import Sequence as Ordered
from pathlib import Path

from ldo_service.actors.topology import GRAPH, ActorSpec
from ldo_service.config import actor_parameters, config_yaml, stage_parameters
from ldo_service.errors import ConfigError
from ldo_service.runtime.actor_graph import consumers_with_backlog, finish_order, lossless_consumers
from ldo_service.runtime.stage import Stage
from ldo_service.runtime.supervision import StopRequest, supervise
from ldo_service.schemas import Health, decode, encode
from ldo_service.schemas.topics import CAMERA_RGBD, ODOMETRY_PRIOR, Topic
from ldo_service.storage.temporary_folder import temporary_folder
from ldo_service.transport.flow_control import Header, data_key, encode_link
from ldo_service.transport.interface import MemoryTransport

from .folder import RunWriter
from .job import Advance, RunOptions
from .offline import require_usable
from .source import FrameReader, interleave_prior
from .summary import Usage, summarize


def run_realtime(job: RunOptions, advance: Advance) -> RunWriter:
    """Run every actor over the selected frames in real time, as the live service does.

    All actors run in this process. Frames arrive at the times of their stamps. If several frames
    arrive while the tracker is busy, only the newest is tracked; the others are dropped and
    counted. Therefore the result depends on the speed and the load of the machine.

    Args:
        job: Options of the run.
        advance: Function that receives the progress.

    Raises:
        ConfigError: `job.refine` is not 0. Only an offline run refines the map after its end.
        DataError: Too few frames can be read.
        StageError: An actor fails.
    """
    if job.refine:
        raise ConfigError("--refine-iterations needs an offline run. Remove --realtime.")
    with temporary_folder() as folder:
        return asyncio.run(_RealTimeRun(job, folder, advance).go())


class _RealTimeRun:
    def __init__(self, job: RunOptions, folder: Path, advance: Advance) -> None:
        self._sequence, self._advance = job.sequence, advance
        self._prior = job.prior
        self._config = job.config.with_map_folder(folder)
        self._indices = job.selection.indices(job.sequence)
        self._reader = FrameReader(job.sequence, self._indices, job.warn)
        tracker = actor_parameters(job.config).tracker
        self._record = RunWriter(job.folder, config_yaml(job.config), tracker)
        self._step_ms: dict[str, float] = {}

    async def go(self) -> RunWriter:
        transport = MemoryTransport()
        stages = [self._stage(spec, transport) for spec in finish_order(GRAPH)]
        for topic in _made_topics():
            self._observe(topic, transport)
        stop = StopRequest()
        started = Usage.now()
        async with asyncio.TaskGroup() as group:
            service = supervise(stages, stop, self._config.service.shutdown_timeout_s, sources=1)
            running = group.create_task(service)
            feeding = group.create_task(self._feed(transport))
            await asyncio.wait({running, feeding}, return_when=asyncio.FIRST_COMPLETED)
            feeding.cancel()
            stop.request()
        used = Usage.now().since(started)
        return self._close(used, [stage.health() for stage in stages])

    def _stage(self, spec: ActorSpec, transport: MemoryTransport) -> Stage:
        make = spec.make
        assert make is not None
        parameters = actor_parameters(self._config)
        return Stage(
            lambda: make(parameters),
            transport,
            config=stage_parameters(self._config),
            expected={
                out.topic.name: lossless_consumers(GRAPH, out.topic.name) for out in spec.outputs
            },
            with_backlog={
                out.topic.name: consumers_with_backlog(GRAPH, out.topic.name)
                for out in spec.outputs
            },
        )

    def _observe(self, topic: Topic, transport: MemoryTransport) -> None:
        kind = topic.message
        transport.subscribe(
            data_key(topic.name),
            lambda _header, body: self._record.observe(decode(body, kind), 0.0),
        )

    async def _feed(self, transport: MemoryTransport) -> None:
        """Send each frame at the time of its stamp, after the older poses of the odometry prior."""
        camera = transport.publisher(data_key(CAMERA_RGBD.name))
        odometry = transport.publisher(data_key(ODOMETRY_PRIOR.name))
        first_ns = int(self._sequence.stamps_ns[self._indices[0]])
        started_s = time.monotonic()
        batches = interleave_prior(self._reader, self._prior)
        number = poses = 0
        while (batch := await asyncio.to_thread(next, batches, None)) is not None:
            *prior, frame = batch
            due_s = started_s + (frame.stamp_ns - first_ns) * 1e-9
            await asyncio.sleep(max(0.0, due_s - time.monotonic()))
            for pose in prior:
                header = Header("odometry", 1, poses, pose.stamp_ns)
                await odometry.send(encode_link(header), encode(pose))
                poses += 1
            header = Header("camera", 1, number, frame.stamp_ns)
            await camera.send(encode_link(header), encode(frame))
            number += 1
            self._advance(number + self._reader.rejected)

    def _close(self, used: Usage, healths: Ordered[Health]) -> RunWriter:
        rejected = self._reader.rejected + sum(
            int(health.metrics.get("frames_rejected", 0)) for health in healths
        )
        stage_ms = {h.actor: {"p50": h.step_ms_p50, "p95": h.step_ms_p95} for h in healths}
        drops = {f"{h.actor} {i.topic}": i.dropped for h in healths for i in h.inputs if i.dropped}
        frames = len(self._indices)
        metrics = {health.actor: health.metrics for health in healths}
        summary = summarize(self._record, used, frames, rejected, stage_ms, drops, metrics)
        self._record.close(summary)
        require_usable(self._record, self._config.offline.max_rejected_ratio)
        return self._record


def _made_topics() -> list[Topic]:
    return [out.topic for spec in GRAPH for out in spec.outputs]
