import numpy as np

from ldo_service.evaluation.label_lists import UNKNOWN, VOID, full_list
from ldo_service.evaluation.label_results import (
    BEYOND,
    CONFUSED,
    INVENTED,
    MISSED,
    RIGHT,
    UNKNOWN_COLOR,
    VOID_COLOR,
    LabelPicture,
    error_colors,
    label_colors,
    label_sheet,
)
from ldo_service.evaluation.pictures import legend
from ldo_service.evaluation.semantics import LabelView
from ldo_service.geometry import Camera, RgbdFrame
from ldo_service.geometry.sequence import FrameLabels

SOURCE = ("undefined", "wall", "chair", "ladder")
MAP = ("background", "other", "chair", "couch")
LABELS = full_list(SOURCE)
CHAIR, LADDER = 1, 2


def test_each_kind_of_error_has_a_color() -> None:
    truth = np.uint8([[0, CHAIR, CHAIR, LADDER, 0, CHAIR, 0, VOID]])
    shown = np.uint8([[0, CHAIR, 0, 0, CHAIR, LADDER, UNKNOWN, CHAIR]])
    picture = error_colors(np.full((1, 8, 3), 100, np.uint8), truth, shown, LABELS)
    expected = (RIGHT, MISSED, BEYOND, INVENTED, CONFUSED, INVENTED, VOID_COLOR)
    assert [tuple(color) for color in picture[0, 1:].tolist()] == list(expected)
    assert picture[0, 0].tolist() == [146, 146, 146], "background is the image in gray"


def test_labels_that_occur_have_colors_of_their_own() -> None:
    colors = label_colors(range(1, 60))
    assert len(np.unique(colors[1:60], axis=0)) == 59
    apart = np.abs(colors[1:12, None].astype(int) - colors[None, 1:12]).sum(axis=2)
    assert apart[~np.eye(11, dtype=bool)].min() > 60
    assert tuple(colors[UNKNOWN]) == UNKNOWN_COLOR
    assert tuple(colors[VOID]) == VOID_COLOR


def test_a_row_shows_camera_truth_map_and_error_above_a_legend() -> None:
    camera = Camera(120, 90, 100.0, 100.0, 59.5, 44.5)
    color = np.full((90, 120, 3), (200, 30, 30), np.uint8)
    frame = RgbdFrame(color, np.ones((90, 120), np.float32), camera)
    truth = FrameLabels(np.full((90, 120), 2, np.uint8), np.ones((90, 120), np.uint16))
    shown = np.zeros((90, 120), np.uint8)
    shown[:, :60] = 2
    sheet = label_sheet([LabelPicture("frame 7", LabelView(frame, truth, shown))], MAP, SOURCE)
    cells = [sheet[100, 6 + 126 * k : 126 + 126 * k] for k in range(4)]
    assert cells[0][10].tolist() == [200, 30, 30]
    np.testing.assert_array_equal(cells[1][10], cells[1][110], "a chair from side to side")
    np.testing.assert_array_equal(cells[2][10], cells[1][10], "the left half is correct")
    assert len(set(cells[2][110].tolist())) == 1, "gray: background on the right"
    assert (tuple(cells[3][10]), tuple(cells[3][110])) == (RIGHT, MISSED)
    assert any(np.all(row == RIGHT) for row in sheet[150:].reshape(-1, 3)), "in the legend"


def test_a_legend_breaks_into_lines_that_fit() -> None:
    entries = [(f"object {k}", (k, 0, 0)) for k in range(40)]
    strip = legend(entries, 400)
    assert strip.shape[1] == 400
    assert strip.shape[0] > legend(entries[:3], 400).shape[0]
    for k in range(40):
        assert np.any(np.all(strip == (k, 0, 0), axis=2)), f"object {k}"
