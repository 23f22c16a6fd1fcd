"""What is sent to a browser, without one."""

import io
from collections.abc import Iterator
from contextlib import nullcontext, redirect_stdout
from typing import Any

import numpy as np
import pytest

from ldo_service.metrics import LOOPBACK
from ldo_service.viewer.config import ViewerConfig
from ldo_service.viewer.splats import splats_of
from ldo_service.viewer.window import Server, Window
from tests.viewer.staged import EVERY_LAYER, GREEN, RED, Staged, chair, scene_of, wall

NODES = ("gaussians", "online", "final", "keyframes", "sights", "objects", "loops", "names/7")
CONFIG = ViewerConfig(port=0, gaussians_s=2.0)


class Camera:
    position = look_at = np.zeros(3)


class Browser:
    """As far as the window asks one."""

    def __init__(self) -> None:
        self.camera = Camera()
        self.atomic = nullcontext

    def flush(self) -> None:
        pass


class Stage:
    """A window whose browsers and whose clock a test sets."""

    def __init__(self, server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
        self.server, self.now_s = server, 0.0
        self.browsers: dict[int, Browser] = {}
        monkeypatch.setattr(server, "get_clients", lambda: self.browsers)
        self.source = Staged(scene_of(wall(RED), chair(0.5)))
        self.window = Window(server, self.source, CONFIG, "test", lambda: self.now_s)

    def node(self, name: str) -> Any:
        return self.server.scene.get_handle_by_name(f"/{name}")

    def show(self) -> None:
        self.window.show(self.source.update())


@pytest.fixture
def stage(monkeypatch: pytest.MonkeyPatch) -> Iterator[Stage]:
    with redirect_stdout(io.StringIO()):
        server = Server(host=CONFIG.address, port=CONFIG.port, verbose=False)
    yield Stage(server, monkeypatch)
    server.stop()


def test_it_is_for_this_machine_alone(stage: Stage) -> None:
    assert stage.window.url.startswith(f"http://{LOOPBACK}:")
    assert stage.server.get_host() == LOOPBACK
    assert stage.server.request_share_url() is None


def test_nothing_is_drawn_before_somebody_looks_and_all_of_it_then(stage: Stage) -> None:
    stage.show()
    assert not any(stage.node(name) for name in NODES)
    stage.browsers[0] = Browser()
    stage.show()
    assert all(stage.node(name) for name in NODES)
    splats = splats_of(stage.source.scene.rows)
    np.testing.assert_array_equal(stage.node("gaussians").centers, splats.centers)


def test_gaussians_are_sent_no_more_often_than_they_may(stage: Stage) -> None:
    stage.browsers[0] = Browser()
    stage.show()
    stage.source.scene.rows, stage.source.changed = wall(GREEN, 1.0), {"gaussians"}
    stage.now_s = 1.9
    stage.show()
    assert len(stage.node("gaussians").centers) == len(wall(RED))
    stage.now_s = 2.1
    stage.show()  # nothing is new, and they are due
    assert len(stage.node("gaussians").centers) == len(wall(GREEN, 1.0))


def test_what_goes_and_comes_goes_and_comes(stage: Stage) -> None:
    stage.browsers[0] = Browser()
    stage.show()
    scene = stage.source.scene
    scene.objects, scene.loops, scene.rows = None, (), wall(RED)[:0]
    stage.source.changed, stage.now_s = set(EVERY_LAYER), 10.0
    stage.show()
    assert stage.node("names/7") is None
    for name in ("objects", "loops"):
        assert len(stage.node(name).points) == 0
    assert len(stage.node("gaussians").centers) == 0
    stage.source.scene = scene_of(wall(GREEN), chair(0.7))
    stage.source.changed, stage.now_s = set(EVERY_LAYER), 20.0
    stage.show()
    assert stage.node("names/7").text.startswith("chair")
    np.testing.assert_allclose(stage.node("names/7").position, [0.7, 0, 3])
    assert len(stage.node("gaussians").centers) == len(wall(GREEN))


def test_who_looks_first_looks_from_the_camera_and_then_where_he_likes(stage: Stage) -> None:
    stage.browsers[0] = Browser()
    stage.show()
    camera = stage.browsers[0].camera
    np.testing.assert_allclose(camera.look_at, [0, 0, 2])
    camera.look_at = np.ones(3)
    stage.source.changed = set(EVERY_LAYER)
    stage.show()
    np.testing.assert_array_equal(camera.look_at, np.ones(3))
