"""Recordings of the whole service in one event loop over the synthetic room."""

import asyncio
from collections.abc import Callable
from pathlib import Path

import pytest

from ldo_service.actors.topology import GRAPH
from ldo_service.config import Config, actor_parameters, load_config
from ldo_service.conversions.frames import raw_frame_to_message
from ldo_service.conversions.poses import pose_to_message
from ldo_service.datasets import Sequence
from ldo_service.geometry import Trajectory
from ldo_service.runtime import Out
from ldo_service.runtime.actor_graph import consumers_with_backlog, finish_order, lossless_consumers
from ldo_service.runtime.outlet import Outlet
from ldo_service.runtime.stage import Stage
from ldo_service.runtime.supervision import wait_until_quiet
from ldo_service.schemas import OdometryPrior
from ldo_service.schemas.topics import CAMERA_RGBD, ODOMETRY_PRIOR
from ldo_service.service.service import open_recorder
from ldo_service.storage.state_store import FolderStore
from ldo_service.transport.interface import MemoryTransport
from tests.runtime.fake_actors import eventually, running, send

FRAMES = 30
ROUGH = "mapper.iterations=2"  # Few for speed, but enough to move keyframes.
REFINING = tuple(
    f"mapper.learning_rate.{rate}=0.001" for rate in ("pose_rotation_rad", "pose_translation_m")
)
CONFIG = load_config(settings=(ROUGH, *REFINING))


def stages(
    folder: Path, transport: MemoryTransport, config: Config, state: Path | None
) -> list[Stage]:
    made: list[Stage] = []
    map_folder = state and state / "map"
    parameters = actor_parameters(config.with_map_folder(map_folder) if map_folder else config)
    for box in finish_order(GRAPH):
        assert box.make is not None
        make, topics = box.make, [out.topic.name for out in box.outputs]
        made.append(
            Stage(
                lambda make=make: make(parameters),
                transport,
                store=FolderStore(state / "state") if state else None,
                expected={name: lossless_consumers(GRAPH, name) for name in topics},
                with_backlog={name: consumers_with_backlog(GRAPH, name) for name in topics},
                journal=open_recorder(folder, box.name, "robot", config, map_folder),
            )
        )
    return made


async def record_service(
    folder: Path,
    sequence: Sequence,
    config: Config = CONFIG,
    count: int = FRAMES,
    prior: Trajectory | None = None,
    until: Callable[[dict[str, Stage]], bool] = lambda _: True,
    state: Path | None = None,
    first: int = 0,
) -> None:
    """Record the service while it receives a sequence frame by frame, and stop it gracefully.

    Args:
        folder: Folder of the recording.
        sequence: Source of the frames.
        config: Configuration of the service.
        count: Number of frames.
        prior: Prior poses, each sent before the frame of the same index.
        until: Condition on the stages by name that must hold before the stop.
        state: State folder, from which the service continues; None for states in memory.
        first: Index of the first frame.
    """
    transport = MemoryTransport()
    actors = stages(folder, transport, config, state)
    camera = Outlet(Out(CAMERA_RGBD), "camera", 1 + first, transport)
    odometry = Outlet(Out(ODOMETRY_PRIOR), "odometry", 1, transport)
    async with running(*actors) as tasks:
        tracker = next(stage for stage in actors if stage.name == "tracker")
        for index in range(first, first + count):
            if prior is not None:
                stamp_ns = round(1e9 * prior.stamps_s[index])
                pose = pose_to_message(prior.T_world_camera[index])
                await send(odometry, OdometryPrior(stamp_ns=stamp_ns, T_prior_base=pose))
            await send(camera, raw_frame_to_message(sequence.read(index)))
            await eventually(lambda frames=index + 1 - first: frames_received(tracker) == frames)
        await eventually(lambda: until({stage.name: stage for stage in actors}))
        await wait_until_quiet(actors, 60)
        for stage, task in zip(actors, tasks, strict=True):
            stage.drain()
            await task


def frames_received(tracker: Stage) -> int:
    return next(i.delivered for i in tracker.health().inputs if i.topic == "frame/rgbd")


@pytest.fixture(scope="session")
def recording(room: Sequence, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of thirty frames; tests must not change it."""
    folder = tmp_path_factory.mktemp("recording")
    asyncio.run(record_service(folder, room))
    return folder


@pytest.fixture
def recording_copy(recording: Path, tmp_path: Path) -> Path:
    """A copy of the recording; tests may change the copy."""
    for path in recording.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    return tmp_path
