"""Tests of what the window sends to browsers, with fake browsers."""

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
from tests.viewer.scenes import EVERY_LAYER, GREEN, RED, ManualSource, chair, scene_of, wall

NODES = ("gaussians", "online", "final", "keyframes", "detections", "objects", "loops", "names/7")
CONFIG = ViewerConfig(port=0, gaussians_s=2.0)


class Camera:
    """Camera of a fake browser."""

    position = look_at = np.zeros(3)


class Browser:
    """Fake browser with the interface that the window uses."""

    def __init__(self) -> None:
        self.camera = Camera()
        self.atomic = nullcontext

    def flush(self) -> None:
        pass


class WindowHarness:
    """Window with browsers and a clock that a test sets."""

    def __init__(self, server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
        self.server, self.now_s = server, 0.0
        self.browsers: dict[int, Browser] = {}
        monkeypatch.setattr(server, "get_clients", lambda: self.browsers)
        self.source = ManualSource(scene_of(wall(RED), chair(0.5)))
        self.window = Window(server, self.source, CONFIG, "test", lambda: self.now_s)

    def node(self, name: str) -> Any:
        return self.server.scene.get_handle_by_name(f"/{name}")

    def show(self) -> None:
        self.window.show(self.source.update())


@pytest.fixture
def harness(monkeypatch: pytest.MonkeyPatch) -> Iterator[WindowHarness]:
    with redirect_stdout(io.StringIO()):
        server = Server(host=CONFIG.address, port=CONFIG.port, verbose=False)
    yield WindowHarness(server, monkeypatch)
    server.stop()


def test_window_is_served_on_loopback_only(harness: WindowHarness) -> None:
    assert harness.window.url.startswith(f"http://{LOOPBACK}:")
    assert harness.server.get_host() == LOOPBACK
    assert harness.server.request_share_url() is None


def test_layers_are_drawn_only_once_a_browser_is_connected(harness: WindowHarness) -> None:
    harness.show()
    assert not any(harness.node(name) for name in NODES)
    harness.browsers[0] = Browser()
    harness.show()
    assert all(harness.node(name) for name in NODES)
    splats = splats_of(harness.source.scene.rows)
    np.testing.assert_array_equal(harness.node("gaussians").centers, splats.centers)


def test_layers_have_the_positions_of_the_scene(harness: WindowHarness) -> None:
    harness.browsers[0] = Browser()
    harness.show()
    scene = harness.source.scene
    for name, positions in (("online", scene.online), ("final", scene.final)):
        np.testing.assert_allclose(harness.node(name).points[:, 0], positions[:-1], atol=1e-6)
    ends = [scene.keyframes[k][:3, 3] for k in scene.loops[0]]
    np.testing.assert_allclose(harness.node("loops").points[0], ends, atol=1e-6)
    scene.keyframes = {k: T + 1 for k, T in scene.keyframes.items()}
    harness.source.changed, harness.now_s = {"keyframes"}, 10.0
    harness.show()
    np.testing.assert_allclose(harness.node("loops").points[0], np.array(ends) + 1, atol=1e-6)


def test_hidden_layers_stay_hidden_after_an_update(harness: WindowHarness) -> None:
    harness.browsers[0] = Browser()
    harness.show()
    nodes = {"labels": "names/7"}
    for name, box in harness.window._boxes.items():
        box.value = False
        harness.window._set_visible(name, False)
        assert not harness.node(nodes.get(name, name)).visible, name
    harness.source.changed, harness.now_s = set(EVERY_LAYER), 10.0
    harness.show()
    assert not any(harness.node(nodes.get(name, name)).visible for name in harness.window._boxes)


def test_up_direction_is_refined_with_later_keyframes(
    harness: WindowHarness, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first keyframe is tilted down here, and the others are not."""
    ups: list[np.ndarray] = []
    monkeypatch.setattr(harness.server.scene, "set_up_direction", ups.append)
    scene = harness.source.scene
    level, tilted = np.eye(4), se3.exp(np.array([-0.5, 0, 0, 0, 0, 0]))
    scene.keyframes = {0: tilted}
    harness.browsers[0] = Browser()
    harness.show()
    np.testing.assert_allclose(ups[-1], -tilted[:3, 1], atol=1e-6)
    turned = se3.exp(np.array([0, 1.5, 0, 0, 0, 0]))
    for number in range(1, 9):
        scene.keyframes = {**scene.keyframes, number: turned if number % 2 else level}
        harness.source.changed, harness.now_s = {"keyframes"}, 10.0 * number
        harness.show()
    assert np.arccos(-ups[-1][1]) < 0.1
    assert len(ups) == 4, "set at 1, 2, 4 and 8 keyframes, so that the horizon seldom moves"


def test_mark_of_a_found_object_follows_the_object(harness: WindowHarness) -> None:
    harness.browsers[0] = Browser()
    harness.window._found = 7
    harness.show()
    first = harness.node("found").points.mean(axis=(0, 1))
    scene = harness.source.scene
    scene.objects = scene_of(wall(RED), chair(1.5)).objects
    harness.source.changed, harness.now_s = {"objects"}, 10.0
    harness.show()
    moved = harness.node("found").points.mean(axis=(0, 1)) - first
    np.testing.assert_allclose(moved, [1, 0, 0], atol=1e-6)
    scene.objects, harness.source.changed, harness.now_s = None, {"objects"}, 20.0
    harness.show()
    assert len(harness.node("found").points) == 0


def test_new_map_resets_the_view_and_the_found_object(harness: WindowHarness) -> None:
    harness.browsers[0] = Browser()
    harness.window._found = 7
    harness.show()
    harness.browsers[0].camera.look_at = np.ones(3)
    harness.source.scene = scene_of(wall(GREEN), chair(0.7))
    harness.source.changed, harness.now_s = set(EVERY_LAYER), 10.0
    harness.show()
    np.testing.assert_allclose(harness.browsers[0].camera.look_at, [0, 0, 2])
    assert len(harness.node("found").points) == 0, "object 7 of the new map is another object"


def test_address_of_another_machine_is_rejected() -> None:
    config = ViewerConfig(address="192.0.2.1")  # Documentation address of RFC 5737.
    with (
        pytest.raises(ConfigError, match=r"viewer\.address=192\.0\.2\.1 must be"),
        open_window(ManualSource(scene_of(wall(RED))), config, "test"),
    ):
        pass


def test_gaussians_are_sent_at_most_once_per_interval(harness: WindowHarness) -> None:
    harness.browsers[0] = Browser()
    harness.show()
    harness.source.scene.rows, harness.source.changed = wall(GREEN, 1.0), {"gaussians"}
    harness.now_s = 1.9
    harness.show()
    assert len(harness.node("gaussians").centers) == len(wall(RED))
    harness.now_s = 2.1
    harness.show()  # The interval is over.
    assert len(harness.node("gaussians").centers) == len(wall(GREEN, 1.0))


def test_removed_layers_disappear_and_new_ones_appear(harness: WindowHarness) -> None:
    harness.browsers[0] = Browser()
    harness.show()
    scene = harness.source.scene
    scene.objects, scene.loops, scene.rows = None, (), wall(RED)[:0]
    harness.source.changed, harness.now_s = set(EVERY_LAYER), 10.0
    harness.show()
    assert harness.node("names/7") is None
    for name in ("objects", "loops"):
        assert len(harness.node(name).points) == 0
    assert len(harness.node("gaussians").centers) == 0
    harness.source.scene = scene_of(wall(GREEN), chair(0.7))
    harness.source.changed, harness.now_s = set(EVERY_LAYER), 20.0
    harness.show()
    assert harness.node("names/7").text.startswith("chair")
    np.testing.assert_allclose(harness.node("names/7").position, [0.7, 0, 3])
    assert len(harness.node("gaussians").centers) == len(wall(GREEN))


def test_view_starts_at_the_camera_and_is_not_moved_again(harness: WindowHarness) -> None:
    harness.browsers[0] = Browser()
    harness.show()
    camera = harness.browsers[0].camera
    np.testing.assert_allclose(camera.look_at, [0, 0, 2])
    camera.look_at = np.ones(3)
    harness.source.changed = set(EVERY_LAYER)
    harness.show()
    np.testing.assert_array_equal(camera.look_at, np.ones(3))
