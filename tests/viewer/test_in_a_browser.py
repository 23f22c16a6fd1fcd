"""The window as somebody sees it, in a headless Chromium with WebGL on the CPU."""

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
from tests.viewer.scenes import GREEN, RED, Staged, chair, scene_of, wall

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]
CONFIG = ViewerConfig(port=0, gaussians_s=0.5)
LIT = 40  # of 255: the background is darker


@contextmanager
def shown(source: Source, folder: Path) -> Iterator[tuple[Page, Window]]:
    """A page that shows what the source has, as it comes."""
    with open_window(source, CONFIG, "test") as window, browser(folder) as page:
        page.open(window.url)
        ended = threading.Event()
        thread = threading.Thread(target=_keep_up, args=(window, source, ended))
        thread.start()
        try:
            page.wait_for(lambda: "Where is" in page.text(), "the panel")
            yield page, window
        finally:
            ended.set()
            thread.join()


def _keep_up(window: Window, source: Source, ended: threading.Event) -> None:
    while not ended.wait(0.1):
        window.show(source.update())


def picture(page: Page) -> np.ndarray:
    """The middle of the screenshot [H, W, 3]: neither the panel nor what is told of software
    rendering."""
    image = page.screenshot()
    height, width, _ = image.shape
    return image[height // 3 :, width // 3 : 3 * width // 5]


def share_lit(page: Page) -> float:
    return float((picture(page).max(axis=2) > LIT).mean())


def share_of(page: Page, color: tuple[float, float, float]) -> float:
    """Of pixels in which this colour's channel is by far the strongest."""
    image, channel = picture(page).astype(int), int(np.argmax(color))
    others = np.delete(image, channel, axis=2).max(axis=2)
    return float((image[..., channel] > others + 60).mean())


def wait_for_share(page: Page, share: Callable[[], float], least: float, what: str) -> None:
    page.wait_for(lambda: share() > least, what, timeout_s=120)


def test_pixels_change_when_the_map_does(tmp_path: Path) -> None:
    source = Staged(scene_of(wall(RED)[:0]))
    source.scene.online = source.scene.final = np.zeros((0, 3))
    source.scene.keyframes, source.scene.loops = {}, ()
    with shown(source, tmp_path) as (page, _):
        time.sleep(3)
        assert share_of(page, RED) < 0.01
        for color, other in ((RED, GREEN), (GREEN, RED)):
            source.scene.rows = wall(color)
            source.changed = {"gaussians"}
            wait_for_share(page, lambda c=color: share_of(page, c), 0.5, f"coloured {color}")
            assert share_of(page, other) < 0.01
        source.scene.rows = wall(GREEN)[:0]
        source.changed = {"gaussians"}
        wait_for_share(page, lambda: 1 - share_of(page, GREEN), 0.99, "empty again")


def test_who_asks_flies_to_the_answer(tmp_path: Path) -> None:
    source = Staged(scene_of(wall(GREEN), chair(x_m=0.5)))
    with shown(source, tmp_path) as (page, window):
        wait_for_share(page, lambda: share_of(page, GREEN), 0.2, "drawn")
        page.type_into("form input", "armchair")
        page.wait_for(lambda: "0.81" in page.text(), "an answer: chair is what an armchair is")
        expected = view_of(chair(0.5), source.scene.keyframes, np.zeros(3))
        (eye,) = window.eyes()
        page.wait_for(
            lambda: np.allclose(window.eyes()[0].position, expected.position, atol=1e-3),
            f"flown from {eye} to {expected}",
        )
        page.type_into("form input", "piano")
        page.wait_for(lambda: "none of 1 objects" in page.text(), "a word that there is none")


def test_a_finished_run_is_a_picture(finished_run: Path, tmp_path: Path) -> None:
    with shown(RunFolder(finished_run, CONFIG), tmp_path) as (page, _):
        wait_for_share(page, lambda: share_lit(page), 0.6, "a picture")
        assert "16 frames" in page.text()
        with_gaussians = picture(page)
        page.click_checkbox("Gaussians")
        wait_for_share(page, lambda: 1 - share_lit(page), 0.7, "without its Gaussians")
        assert np.abs(picture(page).astype(int) - with_gaussians).mean() > 20


def test_a_service_is_watched_while_its_map_grows(tmp_path: Path) -> None:
    with live_service(tmp_path, "--set", "mapper.iterations=2") as service:
        service.wait_for_actors()
        command = [*LDO, "view", "live", "--endpoint", service.endpoint, "--set", "viewer.port=0"]
        viewer = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        try:
            assert viewer.stderr
            url = viewer.stderr.readline().split()[-1]
            with browser(tmp_path) as page:
                page.open(url)
                page.wait_for(lambda: "no pose yet" in page.text(), "a service without frames")
                assert share_lit(page) < 0.05
                publisher = service.publisher("synthetic:room", "--rate", "3", "--max-frames", "40")
                wait_for_share(page, lambda: share_lit(page), 0.4, "a picture")
                page.wait_for(lambda: "tracker" in page.text(), "told how the actors are")
                publisher.kill()
                publisher.wait()
        finally:
            viewer.terminate()
            assert viewer.wait(30) == 0
            viewer.stderr.close()
