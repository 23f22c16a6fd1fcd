"""Window in the browser; the only module that imports viser."""

import io
import logging
import math
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from typing import Any

import numpy as np
import viser

from ldo_service.errors import ConfigError, LdoError
from ldo_service.maps.object_search import ObjectMatch, find_objects
from ldo_service.schemas import MapObject
from ldo_service.transport.endpoint import LOOPBACK

from .flight import CameraView, estimate_up, interpolate_views, overview, view_of
from .lines import (
    FINAL,
    FOUND,
    ONLINE,
    Lines,
    box_lines,
    detection_lines,
    keyframe_lines,
    loop_lines,
    path_lines,
)
from .panel import escaped
from .scene import Layer, Scene, Source, splats_of
from .view_config import ViewerConfig

FLIGHT_STEPS, FLIGHT_STEP_S = 30, 1 / 30
THICK_PX, VERY_THICK_PX = 1.5, 4.0
MAX_ANSWERS = 10  # Maximum matches that are listed.
LEGEND = {  # Checkboxes of layers that can be hidden.
    "gaussians": "Gaussians",
    "online": "path, online",
    "final": "path, corrected",
    "keyframes": "keyframes",
    "detections": "detections",
    "objects": "objects",
    "labels": "names",
    "loops": "loops",
}


class Server(viser.ViserServer):
    """Viser server without public share URLs, so that the map is not sent to other machines."""

    def request_share_url(self, verbose: bool = True) -> str | None:  # noqa: ARG002
        return None


class Window:
    """Window of the viewer in the browser; `open_window` opens it, and `show` updates it."""

    def __init__(
        self,
        server: Server,
        source: Source,
        config: ViewerConfig,
        title: str,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._server, self._source, self._config = server, source, config
        self._clock = clock
        self._due: set[Layer] = set()  # Layers that have changed but are not drawn yet.
        self._drawn_s: dict[Layer, float] = {}
        self._begin()
        self._nodes: dict[str, Any] = {}  # Nodes of viser, by name.
        self._names: dict[int, Any] = {}  # Labels of viser, by object id.
        server.scene.set_up_direction(estimate_up({}))
        server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        self._build_panel(title)

    def _begin(self) -> None:
        """Clear the window, because the scene was replaced."""
        self._shown = self._scene
        # Number of keyframes from which the up direction was estimated; 0 before the first
        # estimate.
        self._leveled_by = 0
        self._found: int | None = None  # Id of the object that the last search found.

    @property
    def url(self) -> str:
        """Address of the window."""
        return f"http://{self._server.get_host()}:{self._server.get_port()}"

    @property
    def is_watched(self) -> bool:
        """True if at least one browser is connected."""
        return bool(self._server.get_clients())

    @property
    def _scene(self) -> Scene:
        return self._source.scene

    # --- panel ------------------------------------------------------------------------------------
    def _build_panel(self, title: str) -> None:
        gui = self._server.gui
        gui.set_panel_label(title)
        self._facts = gui.add_markdown("")
        with gui.add_form("Where is ...") as form:
            self._text = gui.add_text("name", "", hint="Press Enter to move the view to the object")
            form.on_submit(self._fly_to_answer)
        self._answers = gui.add_markdown("")
        with gui.add_folder("Show"):
            self._boxes = {name: self._checkbox(name) for name in LEGEND}

    def _checkbox(self, name: str) -> Any:
        box = self._server.gui.add_checkbox(LEGEND[name], initial_value=True)
        box.on_update(lambda _: self._set_visible(name, box.value))
        return box

    def _set_visible(self, name: str, is_visible: bool) -> None:
        nodes = list(self._names.values()) if name == "labels" else [self._nodes.get(name)]
        for node in nodes:
            if node is not None:
                node.visible = is_visible

    # --- drawing ----------------------------------------------------------------------------------
    def show(self, changed: set[Layer]) -> None:
        """Draw the changed layers, each at most once in its minimum interval.

        While no browser is connected, all drawing is postponed.

        Args:
            changed: Layers that have changed.
        """
        if self._scene is not self._shown:
            self._begin()
        self._due |= changed
        if not self.is_watched:
            return
        now_s = self._clock()
        with self._server.atomic():
            for layer in sorted(self._due):
                if now_s - self._drawn_s.get(layer, -math.inf) >= self._every_s(layer):
                    self._draw[layer](self)
                    self._due.discard(layer)
                    self._drawn_s[layer] = now_s
        self._server.flush()

    def _every_s(self, layer: Layer) -> float:
        """Return the minimum interval between two drawings of a layer, seconds."""
        match layer:
            case "camera":
                return 0.0
            case "gaussians":
                return self._config.gaussians_s
            case _:
                return self._config.lines_s

    def _draw_gaussians(self) -> None:
        splats = splats_of(self._scene.rows)
        arrays = (splats.centers, splats.covariances, splats.colors, splats.opacities)
        if "gaussians" in self._nodes:
            self._nodes["gaussians"].set_gaussians(*arrays)
        elif len(splats.centers):
            is_visible = self._boxes["gaussians"].value
            add = self._server.scene.add_gaussian_splats
            self._nodes["gaussians"] = add("/gaussians", *arrays, visible=is_visible)

    def _draw_camera(self) -> None:
        T_map_camera = self._scene.T_map_camera
        here = () if T_map_camera is None else (T_map_camera,)
        self._draw_lines("camera", keyframe_lines(here, self._scene.camera, ONLINE))
        if T_map_camera is not None and not self._leveled_by:
            self._level()
            self._look_along(T_map_camera)

    def _draw_online(self) -> None:
        self._draw_lines("online", path_lines(self._scene.online, ONLINE))

    def _draw_final(self) -> None:
        self._draw_lines("final", path_lines(self._scene.final, FINAL))

    def _draw_keyframes(self) -> None:
        scene, most = self._scene, self._config.max_keyframes
        chosen = sorted(scene.keyframes)[:: max(1, -(-len(scene.keyframes) // most))]
        keyframes = {k: scene.keyframes[k] for k in chosen}
        self._draw_lines("keyframes", keyframe_lines(keyframes.values(), scene.camera))
        self._draw_lines("detections", detection_lines(keyframes, scene.camera, scene.detections))
        self._draw_loops()
        if self._leveled_by and len(scene.keyframes) >= 2 * self._leveled_by:
            self._level()

    def _draw_loops(self) -> None:
        lines = loop_lines(self._scene.loops, self._scene.keyframes)
        self._draw_lines("loops", lines, VERY_THICK_PX)

    def _draw_objects(self) -> None:
        objects = self._shown_objects()
        self._draw_lines("objects", box_lines(objects))
        for gone in self._names.keys() - {one.id for one in objects}:
            self._names.pop(gone).remove()
        for one in objects:
            self._draw_name(one)
        self._draw_found()

    def _draw_found(self) -> None:
        there = self._scene.objects.objects if self._scene.objects else ()
        found = [one for one in there if one.id == self._found]
        self._draw_lines("found", box_lines(found, FOUND), VERY_THICK_PX)

    def _shown_objects(self) -> list[MapObject]:
        found = self._scene.objects
        by_observations = sorted(
            found.objects if found else (), key=lambda one: (-one.observation_count, one.id)
        )
        return by_observations[: self._config.max_objects]

    def _draw_name(self, one: MapObject) -> None:
        text, position = f"{one.name} {one.confidence:.0%}", one.T_map_object.translation
        if one.id in self._names:
            label = self._names[one.id]
            label.text, label.position = text, np.array(position)
        else:
            is_visible, name = self._boxes["labels"].value, f"/names/{one.id}"
            add = self._server.scene.add_label
            self._names[one.id] = add(
                name, text, position=position, visible=is_visible, anchor="center-center"
            )

    def _draw_facts(self) -> None:
        self._facts.content = self._scene.facts

    _draw: dict[Layer, Callable[["Window"], None]] = {
        "gaussians": _draw_gaussians,
        "camera": _draw_camera,
        "online": _draw_online,
        "final": _draw_final,
        "keyframes": _draw_keyframes,
        "objects": _draw_objects,
        "loops": _draw_loops,
        "facts": _draw_facts,
    }

    def _draw_lines(self, name: str, lines: Lines, thickness_px: float = THICK_PX) -> None:
        if name in self._nodes:
            self._nodes[name].points, self._nodes[name].colors = lines.points, lines.colors
        elif len(lines.points):
            is_visible = self._boxes[name].value if name in self._boxes else True
            self._nodes[name] = self._server.scene.add_line_segments(
                f"/{name}",
                lines.points,
                lines.colors,
                thickness=thickness_px,
                thickness_units="screen",
                visible=is_visible,
            )

    # --- camera of the browser --------------------------------------------------------------------
    def _level(self) -> None:
        """Estimate the up direction from the keyframes so far, and set it in the browser.

        The direction is estimated again each time the number of keyframes has doubled, because the
        first keyframes alone may be tilted.
        """
        self._leveled_by = max(1, len(self._scene.keyframes))
        self._server.scene.set_up_direction(estimate_up(self._scene.keyframes))

    def _look_along(self, T_map_camera: np.ndarray) -> None:
        """Set the initial view of all current and future browsers; users then control it."""
        view = overview(T_map_camera)
        initial = self._server.initial_camera
        initial.position, initial.look_at = view.position, view.look_at
        for client in self._server.get_clients().values():
            _set_view(client, view)

    def eyes(self) -> list[CameraView]:
        """Return the current view of the virtual camera in each connected browser."""
        cameras = (client.camera for client in self._server.get_clients().values())
        return [CameraView(camera.position, camera.look_at) for camera in cameras]

    def _fly_to_answer(self, event: viser.GuiEvent[Any]) -> None:
        """Search for the name that the user typed, and move the browser's camera to the best match.

        Viser calls this method in its own thread.
        """
        client, text = event.client, self._text.value.strip()
        found, keyframes = self._scene.objects, self._scene.keyframes
        if client is None or not text:
            return
        if found is None:
            self._answers.content = "The map has no objects. Set detector.model to detect them."
            return
        start = CameraView(client.camera.position, client.camera.look_at)
        try:
            answers = find_objects(text, found, start.position)
        except LdoError as error:
            self._answers.content = escaped(str(error))
            return
        self._answers.content = "\n".join(map(_line, answers[:MAX_ANSWERS]))
        (best,) = (one for one in found.objects if one.id == answers[0].id)
        self._found = best.id
        self._due.add("objects")
        for view in interpolate_views(
            start, view_of(best, keyframes, start.position), FLIGHT_STEPS
        ):
            if client.client_id not in self._server.get_clients():
                return  # The browser was closed.
            _set_view(client, view)
            time.sleep(FLIGHT_STEP_S)


def _set_view(client: viser.ClientHandle, view: CameraView) -> None:
    with client.atomic():
        client.camera.position, client.camera.look_at = view.position, view.look_at
    client.flush()


def _line(one: ObjectMatch) -> str:
    away = "" if one.distance is None else f", {one.distance:.1f} m away"
    return f"- **{escaped(one.name)}** {one.id}: {one.score:.2f}{away}"


def _require_own(address: str) -> None:
    """Check that an address belongs to this machine.

    With the address of another machine, viser would try one port after the other and never stop.

    Raises:
        ConfigError: The machine does not have the address.
    """
    try:
        ((family, *_, where), *_) = socket.getaddrinfo(address, 0, type=socket.SOCK_STREAM)
        with socket.socket(family, socket.SOCK_STREAM) as listener:
            listener.bind(where)
    except OSError as error:
        raise ConfigError(
            f"viewer.address={address} must be an address of this machine, such as {LOOPBACK}, or "
            f"0.0.0.0 for all its addresses: {error.strerror}."
        ) from error


@contextmanager
def open_window(source: Source, config: ViewerConfig, title: str) -> Iterator[Window]:
    """Open a context with a window on `config.address`.

    The port is the first free one from `config.port` on.

    Raises:
        ConfigError: The machine does not have the address.
    """
    _require_own(config.address)
    # INFO would log a line per browser, and ERROR a traceback for each program that opens the port
    # and sends no request, such as a scan of the ports.
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
    with redirect_stdout(io.StringIO()):  # Viser prints a banner.
        server = Server(host=config.address, port=config.port, label=title, verbose=False)
    try:
        yield Window(server, source, config, title)
    finally:
        server.stop()
