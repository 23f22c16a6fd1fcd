"""Tests of the window in a headless Chromium with WebGL on the CPU."""

import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from ldo_service.viewer.flight import view_of
from ldo_service.viewer.run_folder import RunFolder
from ldo_service.viewer.scene import Source
from ldo_service.viewer.view_config import ViewerConfig
from ldo_service.viewer.window import Window, open_window
from tests.service.conftest import LDO, live_service
from tests.viewer.browser import Page, browser
from tests.viewer.scenes import GREEN, RED, ManualSource, chair, scene_of, wall

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]
CONFIG = ViewerConfig(port=0, gaussians_s=0.5)
LIT_LEVEL = 40  # Level of 255; the background is darker.


@contextmanager
def open_page(source: Source, folder: Path) -> Iterator[tuple[Page, Window]]:
    """Open a page of a window that a thread keeps up to date with the source."""
    with open_window(source, CONFIG, "test") as window, browser(folder) as page:
        page.open(window.url)
        is_ended = threading.Event()
        thread = threading.Thread(target=_update_window, args=(window, source, is_ended))
        thread.start()
        try:
            page.wait_for(lambda: "Where is" in page.text(), "panel")
            yield page, window
        finally:
            is_ended.set()
            thread.join()


def _update_window(window: Window, source: Source, is_ended: threading.Event) -> None:
    while not is_ended.wait(0.1):
        window.show(source.update())


def screenshot_center(page: Page) -> np.ndarray:
    """Return the middle of the screenshot [H, W, 3].

    It has neither the panel nor the browser's note on software rendering.
    """
    image = page.screenshot()
    height, width, _ = image.shape
    return image[height // 3 :, width // 3 : 3 * width // 5]


def lit_ratio(page: Page) -> float:
    return float((screenshot_center(page).max(axis=2) > LIT_LEVEL).mean())


def color_ratio(page: Page, color: tuple[float, float, float]) -> float:
    """Return the fraction of pixels in which this color's channel is by far the strongest."""
    image, channel = screenshot_center(page).astype(int), int(np.argmax(color))
    others = np.delete(image, channel, axis=2).max(axis=2)
    return float((image[..., channel] > others + 60).mean())


def wait_for_ratio(page: Page, ratio: Callable[[], float], min_ratio: float, what: str) -> None:
    page.wait_for(lambda: ratio() > min_ratio, what, timeout_s=120)


def test_pixels_follow_changes_of_the_map(tmp_path: Path) -> None:
    source = ManualSource(scene_of(wall(RED)[:0]))
    source.scene.online = source.scene.final = np.zeros((0, 3))
    source.scene.keyframes, source.scene.loops = {}, ()
    with open_page(source, tmp_path) as (page, _):
        time.sleep(3)
        assert color_ratio(page, RED) < 0.01
        for color, other in ((RED, GREEN), (GREEN, RED)):
            source.scene.rows = wall(color)
            source.changed = {"gaussians"}
            wait_for_ratio(
                page, lambda c=color: color_ratio(page, c), 0.5, f"wall of color {color}"
            )
            assert color_ratio(page, other) < 0.01
        source.scene.rows = wall(GREEN)[:0]
        source.changed = {"gaussians"}
        wait_for_ratio(page, lambda: 1 - color_ratio(page, GREEN), 0.99, "empty scene")


def test_search_flies_to_the_object_that_it_finds(tmp_path: Path) -> None:
    source = ManualSource(scene_of(wall(GREEN), chair(x_m=0.5)))
    with open_page(source, tmp_path) as (page, window):
        wait_for_ratio(page, lambda: color_ratio(page, GREEN), 0.2, "green wall")
        page.type_into("form input", "armchair")
        page.wait_for(lambda: "0.81" in page.text(), "answer (a chair matches armchair)")
        expected = view_of(chair(0.5), source.scene.keyframes, np.zeros(3))
        (eye,) = window.eyes()
        page.wait_for(
            lambda: np.allclose(window.eyes()[0].position, expected.position, atol=1e-3),
            f"flight from {eye} to {expected}",
        )
        page.type_into("form input", "piano")
        page.wait_for(lambda: "none of 1 objects" in page.text(), "report that no object matches")


def test_finished_run_is_drawn(finished_run: Path, tmp_path: Path) -> None:
    with open_page(RunFolder(finished_run, CONFIG), tmp_path) as (page, _):
        wait_for_ratio(page, lambda: lit_ratio(page), 0.6, "drawn map")
        assert "16 frames" in page.text()
        with_gaussians = screenshot_center(page)
        page.click_checkbox("Gaussians")
        wait_for_ratio(page, lambda: 1 - lit_ratio(page), 0.7, "image without Gaussians")
        assert np.abs(screenshot_center(page).astype(int) - with_gaussians).mean() > 20


def test_live_service_is_drawn_while_its_map_grows(tmp_path: Path) -> None:
    with live_service(tmp_path, "--set", "mapper.iterations=2") as service:
        service.wait_for_actors()
        command = [*LDO, "view", "live", "--endpoint", service.endpoint, "--set", "viewer.port=0"]
        viewer = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        try:
            assert viewer.stderr
            url = viewer.stderr.readline().split()[-1]
            with browser(tmp_path) as page:
                page.open(url)
                page.wait_for(
                    lambda: "no pose yet" in page.text(), "note that no pose was received"
                )
                assert lit_ratio(page) < 0.05
                publisher = service.publisher("synthetic:room", "--rate", "3", "--max-frames", "40")
                wait_for_ratio(page, lambda: lit_ratio(page), 0.4, "drawn map")
                page.wait_for(lambda: "tracker" in page.text(), "state of the actors")
                publisher.kill()
                publisher.wait()
        finally:
            viewer.terminate()
            assert viewer.wait(30) == 0
            viewer.stderr.close()
