"""Pictures of results as uint8 RGB images."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ldo_service.geometry import Trajectory, associate, se3

from .trajectory import ASSOCIATION_TOLERANCE_S, MIN_POSES, fit_rigid_transform

Color = tuple[int, int, int]
BACKGROUND, INK, GRID = (255, 255, 255), (60, 60, 60), (232, 232, 232)
TRUTH, ESTIMATE = (120, 120, 120), (31, 111, 235)
START, END = (46, 160, 67), (207, 34, 46)
FONT = cv2.FONT_HERSHEY_SIMPLEX
PANEL_PX, MARGIN_PX, CAPTION_PX = 480, 44, 26
SUBPIXEL_BITS = 4
NAMES = "xyz"


def trajectory_picture(estimate: Trajectory, truth: Trajectory | None) -> np.ndarray:
    """Draw the estimated (blue) and the true trajectory (gray) from above and from the side.

    If at least three estimated poses have a true pose within 20 ms, the estimate is aligned to the
    truth. The truth is then drawn only from the first to the last of these true poses. The view
    from above shows the two world axes with the largest extent of the camera motion.

    Returns:
        The picture, RGB [H, W, 3] uint8.
    """
    positions = estimate.T_world_camera[:, :3, 3]
    lines = [_Line(positions, ESTIMATE, "estimate")]
    if truth is not None:
        known = truth.T_world_camera[:, :3, 3]
        pairs = associate(estimate.stamps_s, truth.stamps_s, ASSOCIATION_TOLERANCE_S)
        if len(pairs) >= MIN_POSES:
            T = fit_rigid_transform(positions[pairs[:, 0]], known[pairs[:, 1]])
            lines = [_Line(se3.transform(T, positions), ESTIMATE, "estimate")]
            known = known[pairs[0, 1] : pairs[-1, 1] + 1]
        lines.insert(0, _Line(known, TRUTH, "ground truth"))
    lines = [line for line in lines if len(line.points_m)]
    points_m = np.concatenate([line.points_m for line in lines] or [np.zeros((1, 3))])
    short, middle, long = np.argsort(np.ptp(points_m, axis=0), kind="stable")
    views = [_view(lines, points_m, (long, up)) for up in (middle, short)]
    picture = np.hstack(views)
    _legend(picture, lines)
    return picture


def depth_picture(depth_m: np.ndarray, range_m: tuple[float, float] | None = None) -> np.ndarray:
    """Draw depth in Turbo colors: near is red, far is blue, unknown is black.

    Args:
        depth_m: Depth, [H, W], meters; 0 or not finite where unknown.
        range_m: Nearest and farthest depth of the color scale, meters; None for the values of
            `depth_range`.

    Returns:
        The picture, RGB [H, W, 3] uint8.
    """
    seen = np.isfinite(depth_m) & (depth_m > 0)
    if not seen.any():
        return np.zeros((*depth_m.shape, 3), np.uint8)
    nearest, farthest = range_m or depth_range(depth_m)
    nearness = (farthest - np.where(seen, depth_m, farthest)) / max(farthest - nearest, 1e-6)
    gray = np.clip(nearness * 255, 0, 255).astype(np.uint8)
    image = cv2.cvtColor(cv2.applyColorMap(gray, cv2.COLORMAP_TURBO), cv2.COLOR_BGR2RGB)
    image[~seen] = 0
    return image


def depth_range(depth_m: np.ndarray) -> tuple[float, float]:
    """Return the 2nd and 98th percentiles of the known depth, meters; zeros if none is known."""
    seen = depth_m[np.isfinite(depth_m) & (depth_m > 0)]
    if seen.size == 0:
        return 0.0, 0.0
    nearest, farthest = np.percentile(seen, [2, 98])
    return float(nearest), float(farthest)


def error_picture(a: np.ndarray, b: np.ndarray, gain: float) -> np.ndarray:
    """Return gain * |a - b| as a uint8 image, for two images a and b [H, W, 3] in 0..1."""
    return np.round(np.clip(gain * np.abs(a - b), 0, 1) * 255).astype(np.uint8)


def contact_sheet(
    rows: list[list[np.ndarray]], captions: list[str], labels: list[str] | None = None
) -> np.ndarray:
    """Arrange images in rows, with a caption above each column and a label above each row.

    All images are scaled to fit into the size of the first image.

    Args:
        rows: Images [H, W, 3] uint8.
        captions: A caption for each column.
        labels: A label for each row; None for no labels.

    Raises:
        ValueError: If there is no image, or the numbers of images, captions and labels differ.
    """
    if not rows or any(len(row) != len(captions) for row in rows) or not captions:
        raise ValueError(
            "a contact sheet must have at least one row, and one image per caption in each row"
        )
    if labels is not None and len(labels) != len(rows):
        raise ValueError("a contact sheet must have a label for each row, or no labels at all")
    height, width = rows[0][0].shape[:2]
    gap, label_px = 6, CAPTION_PX if labels else 0
    row_px = label_px + height + gap
    sheet_size = (CAPTION_PX + len(rows) * row_px, len(captions) * (width + gap) + gap, 3)
    sheet = np.full(sheet_size, 255, np.uint8)
    for column, caption in enumerate(captions):
        left = gap + column * (width + gap)
        _text(sheet, caption, (left, CAPTION_PX - 8))
        for row, images in enumerate(rows):
            top = CAPTION_PX + row * row_px + label_px
            sheet[top : top + height, left : left + width] = _fitted(images[column], width, height)
    for row, label in enumerate(labels or []):
        _text(sheet, label, (gap, CAPTION_PX + row * row_px + label_px - 8))
    return sheet


def legend(entries: list[tuple[str, Color]], width_px: int) -> np.ndarray:
    """Draw names with their colors, in as many lines as necessary; [H, width_px, 3] uint8."""
    places, x, line = [], MARGIN_PX // 2, 0
    for name, _ in entries:
        wide = 34 + 9 * len(name)
        if x + wide > width_px and x > MARGIN_PX // 2:
            x, line = MARGIN_PX // 2, line + 1
        places.append((x, line))
        x += wide
    strip = np.full(((line + 1) * CAPTION_PX, width_px, 3), 255, np.uint8)
    for (name, color), (x, line) in zip(entries, places, strict=True):
        y = line * CAPTION_PX
        cv2.rectangle(strip, (x - 6, y + 6), (x + 6, y + 18), color, cv2.FILLED)
        cv2.rectangle(strip, (x - 6, y + 6), (x + 6, y + 18), INK)
        _text(strip, name, (x + 12, y + 17))
    return strip


@dataclass(frozen=True, slots=True)
class _Line:
    points_m: np.ndarray  # [K, 3].
    color: Color
    name: str


def _view(lines: list[_Line], points_m: np.ndarray, axes: tuple[int, int]) -> np.ndarray:
    """Draw one square panel: grid, scale bar, axes and the lines seen along the third axis."""
    panel = np.full((PANEL_PX, PANEL_PX, 3), BACKGROUND, np.uint8)
    across, up = axes
    low, high = points_m.min(axis=0), points_m.max(axis=0)
    center_m = (low + high)[[across, up]] / 2
    extent_m = max(float(np.max(high - low)), 0.05) * 1.08
    px_per_m = (PANEL_PX - 2 * MARGIN_PX) / extent_m
    step_m = _round_step(extent_m / 4)
    _grid(panel, center_m, px_per_m, step_m)
    for line in lines:
        flat = (line.points_m[:, [across, up]] - center_m) * (px_per_m, -px_per_m) + PANEL_PX / 2
        _polyline(panel, flat, line.color)
    _scale_bar(panel, step_m, px_per_m)
    _axes(panel, NAMES[across], NAMES[up])
    return panel


def _polyline(panel: np.ndarray, points_px: np.ndarray, color: Color) -> None:
    fixed = np.round(points_px * 2**SUBPIXEL_BITS).astype(np.int32).reshape(-1, 1, 2)
    cv2.polylines(panel, [fixed], False, color, 2, cv2.LINE_AA, SUBPIXEL_BITS)
    if color == ESTIMATE:
        for end, mark in ((points_px[0], START), (points_px[-1], END)):
            center = (round(float(end[0])), round(float(end[1])))
            cv2.circle(panel, center, 5, mark, -1, cv2.LINE_AA)


def _grid(panel: np.ndarray, center_m: np.ndarray, px_per_m: float, step_m: float) -> None:
    half_m = PANEL_PX / 2 / px_per_m
    for axis in (0, 1):
        first = np.ceil((center_m[axis] - half_m) / step_m)
        for value_m in np.arange(first * step_m, center_m[axis] + half_m, step_m):
            at = round(PANEL_PX / 2 + (value_m - center_m[axis]) * px_per_m * (1, -1)[axis])
            ends = ((at, 0), (at, PANEL_PX)) if axis == 0 else ((0, at), (PANEL_PX, at))
            cv2.line(panel, *ends, GRID, 1)


def _scale_bar(panel: np.ndarray, length_m: float, px_per_m: float) -> None:
    right, y = PANEL_PX - 16, PANEL_PX - 16
    left = right - round(length_m * px_per_m)
    cv2.line(panel, (left, y), (right, y), INK, 2)
    for x in (left, right):
        cv2.line(panel, (x, y - 4), (x, y + 4), INK, 2)
    label = f"{length_m:g} m" if length_m >= 1 else f"{length_m * 100:g} cm"
    _text(panel, label, (left, y - 9))


def _axes(panel: np.ndarray, across: str, up: str) -> None:
    origin, length = (16, PANEL_PX - 16), 34
    cv2.arrowedLine(panel, origin, (origin[0] + length, origin[1]), INK, 1, cv2.LINE_AA)
    cv2.arrowedLine(panel, origin, (origin[0], origin[1] - length), INK, 1, cv2.LINE_AA)
    _text(panel, across, (origin[0] + length + 4, origin[1] + 4))
    _text(panel, up, (origin[0] - 4, origin[1] - length - 6))


def _legend(picture: np.ndarray, lines: list[_Line]) -> None:
    x = 14
    entries = [(line.name, line.color) for line in lines] + [("start", START), ("end", END)]
    for name, color in entries:
        cv2.circle(picture, (x, 16), 5, color, -1, cv2.LINE_AA)
        _text(picture, name, (x + 9, 21))
        x += 34 + 9 * len(name)


def _round_step(length_m: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that does not exceed `length_m`."""
    power = 10.0 ** np.floor(np.log10(length_m))
    return float(
        max(factor for factor in (1, 2, 5) if factor * power <= length_m * 1.000001) * power
    )


def _fitted(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """Scale an image into width x height, centered on white."""
    scale = min(width / image.shape[1], height / image.shape[0])
    size = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
    scaled = image if scale == 1 else cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    out = np.full((height, width, 3), 255, np.uint8)
    top, left = (height - size[1]) // 2, (width - size[0]) // 2
    out[top : top + size[1], left : left + size[0]] = scaled
    return out


def _text(image: np.ndarray, text: str, at: tuple[int, int]) -> None:
    cv2.putText(image, text, at, FONT, 0.45, INK, 1, cv2.LINE_AA)


def save_picture(path: Path, image: np.ndarray) -> None:
    """Write an RGB image [H, W, 3] uint8; the file suffix determines the format.

    Raises:
        OSError: If the file cannot be written.
    """
    if not cv2.imwrite(str(path), cv2.cvtColor(image, cv2.COLOR_RGB2BGR)):
        raise OSError(f"{path} cannot be written; check its suffix and the free disk space")
