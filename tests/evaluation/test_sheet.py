import numpy as np
import pytest

from ldo_service.evaluation.sheet import CAPTIONS, WIDTH_PX, rendering_sheet, some_of
from ldo_service.evaluation.views import RenderedView, RenderingErrors, ViewErrors
from ldo_service.gaussians.renderer import Rendering
from ldo_service.geometry import Camera, RgbdFrame

CAMERA = Camera(640, 320, 300.0, 300.0, 320.0, 160.0)


def errors_of(psnrs_db: list[float]) -> RenderingErrors:
    views = (ViewErrors(5 * i + 4, psnr, 0.9, None, 0.01, 1.0) for i, psnr in enumerate(psnrs_db))
    return RenderingErrors("online", "A held out", tuple(views))


def flat_view(frame: int, seen: float = 0.5, shown: float = 0.5) -> RenderedView:
    size = (CAMERA.height, CAMERA.width)
    color = np.full((*size, 3), round(seen * 255), np.uint8)
    depth_m = np.linspace(1, 3, CAMERA.width, dtype=np.float32) * np.ones(size, np.float32)
    picture = np.full((*size, 3), shown, np.float32)
    rendering = Rendering(picture, depth_m, depth_m, np.ones(size, np.float32))
    return RenderedView(RgbdFrame(color, depth_m, CAMERA, 0, frame), rendering)


def test_best_and_worst_frame_are_among_those_shown() -> None:
    psnrs_db = [20.0 + 0.01 * i for i in range(60)]
    psnrs_db[31], psnrs_db[33] = 12.0, 35.0
    frames = [view.frame for view in some_of(errors_of(psnrs_db).views)]
    assert len(frames) == 6
    assert frames == sorted(frames)
    assert {5 * 31 + 4, 5 * 33 + 4} <= set(frames)
    assert frames[0] < 60
    assert frames[-1] > 200


@pytest.mark.parametrize("count", [0, 1, 2, 4])
def test_few_frames_are_all_shown_once(count: int) -> None:
    views = errors_of([20.0] * count).views
    assert some_of(views) == list(views)


def test_a_row_shows_camera_map_error_and_both_depths() -> None:
    sheet = rendering_sheet(
        errors_of([20.0]), lambda frame: flat_view(frame, seen=0.4, shown=0.5), count=1
    )
    cells = np.split(sheet[-WIDTH_PX // 4 - 40 : -40, 6:], len(CAPTIONS), axis=1)
    camera, shown, error, camera_depth, map_depth = (cell[10:-10, 10:-10] for cell in cells)
    np.testing.assert_allclose(camera, 102)
    np.testing.assert_allclose(shown, 128)
    np.testing.assert_allclose(error, 0.1 * 4 * 255, atol=1)
    np.testing.assert_array_equal(camera_depth, map_depth)
    assert camera_depth[5, 5, 0] > camera_depth[5, 5, 2], "near is red"
    assert camera_depth[5, -10, 2] > camera_depth[5, -10, 0], "far is blue"


def test_images_are_scaled_to_the_width_of_the_sheet() -> None:
    sheet = rendering_sheet(errors_of([20.0, 21.0]), flat_view)
    assert sheet.shape[1] == 5 * (WIDTH_PX + 6) + 6
