"""Service with all actors in one event loop, for tests of its state folder.

The images are small and the map offloads its Gaussians early, so that the state folder has every
kind of file within seconds.
"""

import asyncio
import dataclasses
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from unittest.mock import patch

import numpy as np

from ldo_service.actors.topology import GRAPH
from ldo_service.config import actor_parameters, load_config
from ldo_service.conversions.frames import raw_frame_to_message
from ldo_service.datasets import open_sequence
from ldo_service.gaussians.visibility import OffloadConfig
from ldo_service.geometry import RawFrame
from ldo_service.runtime import Out
from ldo_service.runtime.actor_graph import (
    consumers_first,
    consumers_with_backlog,
    finish_order,
    lossless_consumers,
)
from ldo_service.runtime.generations import GenerationKeeper
from ldo_service.runtime.outlet import Outlet
from ldo_service.runtime.stage import Stage
from ldo_service.runtime.stage_commands import CommandSender
from ldo_service.runtime.supervision import wait_until_quiet
from ldo_service.schemas import Health
from ldo_service.schemas.topics import CAMERA_RGBD
from ldo_service.storage.state_store import FolderStore
from ldo_service.transport.interface import MemoryTransport
from tests.runtime.fake_actors import eventually, running, send

SMALLER = 5  # Factor by which the images of the synthetic room are reduced.
CONFIG = load_config(
    settings=(
        "mapper.iterations=1",
        "mapper.checkpoint_interval_keyframes=2",
        "mapper.densify.max_cell_px=16",
        "mapper.offload.max_resident_gaussians=60",
        "tracker.keyframes.max_rotation_rad=0.02",  # A keyframe of almost every frame.
        "tracker.self_calibration=false",
    )
)
ACTORS = tuple(box.name for box in GRAPH)
KEPT = tuple(box.name for box in consumers_first(GRAPH))


def reduced(raw: RawFrame) -> RawFrame:
    """Return a frame with every fifth pixel."""
    camera = raw.camera
    names = ("fx", "fy", "cx", "cy")
    camera = dataclasses.replace(
        camera,
        width=camera.width // SMALLER,
        height=camera.height // SMALLER,
        **{name: getattr(camera, name) / SMALLER for name in names},
    )
    color, depth = (np.ascontiguousarray(a[::SMALLER, ::SMALLER]) for a in (raw.color, raw.depth))
    return dataclasses.replace(raw, camera=camera, color=color, depth=depth)


class SmallService:
    """Running stages of all actors, with their states in a folder."""

    def __init__(self, folder: Path, *, syncs: bool = False) -> None:
        """Create the stages, which restore their states; `open_service` runs them."""
        transport = self.transport = MemoryTransport()
        offload = partial(OffloadConfig, reach_m=1.5, chunk_edge_m=0.9)
        with patch("ldo_service.config.parameters.OffloadConfig", offload):
            parameters = actor_parameters(CONFIG.with_map_folder(folder / "map"))
        self.stages: list[Stage] = []
        for box in finish_order(GRAPH):
            assert box.make is not None
            make, topics = box.make, [out.topic.name for out in box.outputs]
            self.stages.append(
                Stage(
                    lambda make=make: make(parameters),
                    transport,
                    store=FolderStore(folder / "state", syncs=syncs),
                    expected={name: lossless_consumers(GRAPH, name) for name in topics},
                    with_backlog={name: consumers_with_backlog(GRAPH, name) for name in topics},
                )
            )
        store = FolderStore(folder / "state")
        self.keeper = GenerationKeeper(CommandSender(transport), store, KEPT)
        self._camera = Outlet(Out(CAMERA_RGBD), "camera", 1, transport)
        self._room = open_sequence("synthetic:room")
        self._tasks: Sequence[asyncio.Task[None]] = ()

    def health(self, actor: str) -> Health:
        """Return the health message of an actor."""
        (stage,) = (stage for stage in self.stages if stage.name == actor)
        return stage.health()

    def metric(self, actor: str, name: str) -> float:
        """Return a metric in the health message of an actor; 0 if it has none."""
        return self.health(actor).metrics.get(name, 0.0)

    def state_of(self, actor: str) -> str:
        """Return the state in the health message of an actor."""
        return self.health(actor).state

    async def send_frame(self, index: int) -> None:
        """Send a frame of the room, and wait until the tracker has handled it."""
        before = self._frames()
        await send(self._camera, raw_frame_to_message(reduced(self._room.read(index))))
        await eventually(lambda: self._frames() > before)

    def _frames(self) -> int:
        inputs = self.health("tracker").inputs  # Empty until the tracker is ready.
        return next((i.delivered for i in inputs if i.topic == "frame/rgbd"), 0)

    async def wait_until_quiet(self) -> None:
        """Wait until all messages have reached their actors."""
        await wait_until_quiet(self.stages, 30)

    async def stop(self) -> None:
        """Stop the stages in order."""
        for stage, task in zip(self.stages, self._tasks, strict=True):
            stage.drain()
            await task


@asynccontextmanager
async def open_service(folder: Path, *, syncs: bool = False) -> AsyncIterator[SmallService]:
    """Run a service until the block ends; without `SmallService.stop`, it is cancelled."""
    service = SmallService(folder, syncs=syncs)
    async with running(*service.stages) as tasks:
        service._tasks = tasks
        await eventually(lambda: all(service.state_of(a) == "ready" for a in ACTORS))
        yield service
