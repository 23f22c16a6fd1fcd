"""What is sent to a browser, without one."""

import io
from collections.abc import Iterator
from contextlib import nullcontext, redirect_stdout
from typing import Any

import numpy as np
import pytest

from ldo_service.errors import ConfigError
from ldo_service.geometry import se3
from ldo_service.transport.endpoint import LOOPBACK
from ldo_service.viewer.scene import splats_of
from ldo_service.viewer.view_config import ViewerConfig
from ldo_service.viewer.window import Server, Window, open_window
from tests.viewer.scenes import EVERY_LAYER, GREEN, RED, Staged, chair, scene_of, wall

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


def test_each_layer_is_where_the_scene_has_it(stage: Stage) -> None:
    stage.browsers[0] = Browser()
    stage.show()
    scene = stage.source.scene
    for name, positions in (("online", scene.online), ("final", scene.final)):
        np.testing.assert_allclose(stage.node(name).points[:, 0], positions[:-1], atol=1e-6)
    ends = [scene.keyframes[k][:3, 3] for k in scene.loops[0]]
    np.testing.assert_allclose(stage.node("loops").points[0], ends, atol=1e-6)
    scene.keyframes = {k: T + 1 for k, T in scene.keyframes.items()}
    stage.source.changed, stage.now_s = {"keyframes"}, 10.0
    stage.show()
    np.testing.assert_allclose(stage.node("loops").points[0], np.array(ends) + 1, atol=1e-6)


def test_what_may_be_hidden_is(stage: Stage) -> None:
    stage.browsers[0] = Browser()
    stage.show()
    nodes = {"labels": "names/7"}
    for name, box in stage.window._boxes.items():
        box.value = False
        stage.window._set_visible(name, False)
        assert not stage.node(nodes.get(name, name)).visible, name
    stage.source.changed, stage.now_s = set(EVERY_LAYER), 10.0
    stage.show()
    assert not any(stage.node(nodes.get(name, name)).visible for name in stage.window._boxes)


def test_up_is_learnt_from_more_than_the_first_keyframe(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Which is tilted down here, and the others are not."""
    ups: list[np.ndarray] = []
    monkeypatch.setattr(stage.server.scene, "set_up_direction", ups.append)
    scene = stage.source.scene
    level, tilted = np.eye(4), se3.exp(np.array([-0.5, 0, 0, 0, 0, 0]))
    scene.keyframes = {0: tilted}
    stage.browsers[0] = Browser()
    stage.show()
    np.testing.assert_allclose(ups[-1], -tilted[:3, 1], atol=1e-6)
    turned = se3.exp(np.array([0, 1.5, 0, 0, 0, 0]))
    for number in range(1, 9):
        scene.keyframes = {**scene.keyframes, number: turned if number % 2 else level}
        stage.source.changed, stage.now_s = {"keyframes"}, 10.0 * number
        stage.show()
    assert np.arccos(-ups[-1][1]) < 0.1
    assert len(ups) == 4, (
        "at the first, and at 2, 4 and 8: a horizon that moves all the time is none"
    )


def test_what_was_found_is_marked_where_it_is_now(stage: Stage) -> None:
    stage.browsers[0] = Browser()
    stage.window._found = 7
    stage.show()
    first = stage.node("found").points.mean(axis=(0, 1))
    scene = stage.source.scene
    scene.objects = scene_of(wall(RED), chair(1.5)).objects
    stage.source.changed, stage.now_s = {"objects"}, 10.0
    stage.show()
    moved = stage.node("found").points.mean(axis=(0, 1)) - first
    np.testing.assert_allclose(moved, [1, 0, 0], atol=1e-6)
    scene.objects, stage.source.changed, stage.now_s = None, {"objects"}, 20.0
    stage.show()
    assert len(stage.node("found").points) == 0


def test_another_map_is_looked_at_anew(stage: Stage) -> None:
    stage.browsers[0] = Browser()
    stage.window._found = 7
    stage.show()
    stage.browsers[0].camera.look_at = np.ones(3)
    stage.source.scene = scene_of(wall(GREEN), chair(0.7))
    stage.source.changed, stage.now_s = set(EVERY_LAYER), 10.0
    stage.show()
    np.testing.assert_allclose(stage.browsers[0].camera.look_at, [0, 0, 2])
    assert len(stage.node("found").points) == 0, "object 7 is another one now"


def test_an_address_of_another_machine_is_refused() -> None:
    config = ViewerConfig(address="192.0.2.1")  # of RFC 5737, for documents
    with (
        pytest.raises(ConfigError, match=r"viewer\.address=192\.0\.2\.1 must be"),
        open_window(Staged(scene_of(wall(RED))), config, "test"),
    ):
        pass


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
