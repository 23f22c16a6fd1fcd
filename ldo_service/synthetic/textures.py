"""Procedural textures: tiles of natural-looking color, sampled without aliasing.

The painters below return tiles [TILE_TEXELS, TILE_TEXELS, 3] with values of about 0..1.
"""

from dataclasses import dataclass

import numpy as np

Color = tuple[float, float, float]

TILE_TEXELS = 256
# Side of each mipmap level, and the number of texels of all finer levels.
SIDES = TILE_TEXELS >> np.arange(TILE_TEXELS.bit_length())
STARTS = (TILE_TEXELS**2 - SIDES**2) // 3 * 4


@dataclass(frozen=True, slots=True)
class Texture:
    """Square tile that repeats, with its mipmap levels."""

    texels: np.ndarray  # Channels [3, T] in 0..1 of all levels in sequence, level 0 first.
    size_m: float  # Side of the tile.

    def sample(self, u_m: np.ndarray, v_m: np.ndarray, footprint_m: np.ndarray) -> np.ndarray:
        """Return colors [P, 3] in 0..1 at surface coordinates [P].

        Args:
            u_m: Coordinates [P] along the rows of the tile.
            v_m: Coordinates [P] along the columns of the tile.
            footprint_m: Size [P] of a pixel on the surface, over which the texture is averaged.
        """
        level = _log2(footprint_m * (TILE_TEXELS / self.size_m))
        top = TILE_TEXELS.bit_length() - 1
        level = np.clip(level, 0.0, top)
        lower = np.minimum(level.astype(np.int64), top - 1)
        weight = level - lower
        u, v = u_m / self.size_m, v_m / self.size_m
        fine, coarse = self._at(u, v, lower), self._at(u, v, lower + 1)
        return ((1 - weight) * fine + weight * coarse).T

    def _at(self, u: np.ndarray, v: np.ndarray, level: np.ndarray) -> np.ndarray:
        """Return bilinearly interpolated channels [3, P], which NumPy multiplies by [P] quickly.

        Args:
            u: Coordinates [P] along the rows, in tiles.
            v: Coordinates [P] along the columns, in tiles.
            level: Mipmap level [P] of each point, an integer.
        """
        size, start = SIDES[level], STARTS[level]
        x, y = u * size - 0.5, v * size - 0.5
        x0, y0 = np.floor(x), np.floor(y)
        fx, fy = x - x0, y - y0
        column, row, wrap = x0.astype(np.int64), y0.astype(np.int64), size - 1
        left, right = column & wrap, (column + 1) & wrap
        top, bottom = start + (row & wrap) * size, start + ((row + 1) & wrap) * size
        texel = self.texels.take
        upper = texel(top + left, 1) * (1 - fx) + texel(top + right, 1) * fx
        lower = texel(bottom + left, 1) * (1 - fx) + texel(bottom + right, 1) * fx
        return upper * (1 - fy) + lower * fy


def _log2(x: np.ndarray) -> np.ndarray:
    """Return the base-2 logarithm, exact at powers of two and linear between them."""
    mantissa, exponent = np.frexp(x)
    return exponent - 2.0 + 2.0 * mantissa


def mipmapped(tile: np.ndarray, size_m: float) -> Texture:
    """Return the texture of a tile [TILE_TEXELS, TILE_TEXELS, 3] with mipmaps, clipped to 0..1.

    The tile covers a square of `size_m` on a surface.
    """
    levels = [np.clip(tile, 0.0, 1.0)]
    while len(levels[-1]) > 1:
        a = levels[-1]
        levels.append((a[::2, ::2] + a[1::2, ::2] + a[::2, 1::2] + a[1::2, 1::2]) / 4)
    texels = np.concatenate([level.reshape(-1, 3) for level in levels])
    return Texture(np.ascontiguousarray(texels.T), size_m)


def noise(
    rng: np.random.Generator, cells: tuple[int, int] = (4, 4), octaves: int = 6
) -> np.ndarray:
    """Return a tile of noise in -1..1, [TILE_TEXELS, TILE_TEXELS].

    Each octave has half the amplitude of the previous octave. The spectra of photographs fall with
    frequency in a similar way.

    Args:
        rng: Source of the noise.
        cells: Rows and columns of the coarsest octave.
        octaves: Maximum number of octaves; octaves finer than a texel are omitted.
    """
    total, amplitude = np.zeros((TILE_TEXELS, TILE_TEXELS)), 0.5
    rows, columns = cells
    for _ in range(octaves):
        if max(rows, columns) > TILE_TEXELS:
            break
        total += amplitude * _smooth_lattice(rng.random((rows, columns)) * 2 - 1)
        rows, columns, amplitude = rows * 2, columns * 2, amplitude / 2
    return total


def _smooth_lattice(lattice: np.ndarray) -> np.ndarray:
    """Return a periodic lattice interpolated smoothly to a tile."""
    for axis in (0, 1):
        n = lattice.shape[axis]
        x = np.arange(TILE_TEXELS) * (n / TILE_TEXELS)
        cell = x.astype(np.int64)
        t = x - cell
        weight = t * t * (3 - 2 * t)
        weight = weight[:, None] if axis == 0 else weight[None, :]
        here, there = lattice.take(cell, axis), lattice.take((cell + 1) % n, axis)
        lattice = here * (1 - weight) + there * weight
    return lattice


def blend(a: Color, b: Color, weight: np.ndarray) -> np.ndarray:
    """Return colors [..., 3] between a (weight 0) and b (weight 1)."""
    weight = np.clip(weight, 0.0, 1.0)[..., None]
    return np.array(a) * (1 - weight) + np.array(b) * weight


def plaster(rng: np.random.Generator, color: Color) -> np.ndarray:
    """Draw a painted wall of nearly uniform color, like real walls."""
    tone = 1 + 0.05 * noise(rng, (2, 2)) + 0.03 * noise(rng, (64, 64), 2)
    return np.array(color) * tone[..., None]


def wallpaper(rng: np.random.Generator, paper: Color, print_: Color) -> np.ndarray:
    """Draw soft vertical stripes with a printed motif."""
    column = np.arange(TILE_TEXELS) % 64
    stripe = np.where(column < 32, 0.0, 0.35)[None, :]
    y, x = np.mgrid[:TILE_TEXELS, :TILE_TEXELS] % 64
    petal = np.abs(x - 16) + np.abs(y - 32) + 0.02 * (x - 16) * (y - 32)
    motif = np.where((petal < 13) & (petal > 4), 0.8, 0.0)
    return blend(paper, print_, stripe + motif + 0.12 * noise(rng, (8, 8)))


def planks(rng: np.random.Generator, light: Color, dark: Color) -> np.ndarray:
    """Draw wooden boards along v, each with its own tone, with grain and dark joints."""
    count, width = 8, TILE_TEXELS // 8
    board = np.arange(TILE_TEXELS) // width
    tone = rng.random(count)[board][None, :]
    shift = rng.integers(0, TILE_TEXELS, count)[board]
    rows = (np.arange(TILE_TEXELS)[:, None] + shift[None, :]) % TILE_TEXELS
    grain = noise(rng, (2, 32), 4)[rows, np.arange(TILE_TEXELS)[None, :]]
    joint = (np.arange(TILE_TEXELS) % width < 1)[None, :] | (rows < 2)
    return blend(light, dark, 0.15 + 0.45 * tone + 0.5 * grain + 0.6 * joint)


def wood(rng: np.random.Generator, light: Color, dark: Color) -> np.ndarray:
    """Draw veneer with long grain."""
    return blend(light, dark, 0.45 + 0.35 * noise(rng, (2, 16), 5) + 0.4 * noise(rng, (4, 64), 2))


def fabric(rng: np.random.Generator, color: Color, thread: Color) -> np.ndarray:
    """Draw woven cloth: a visible weave under large soft folds."""
    y, x = np.mgrid[:TILE_TEXELS, :TILE_TEXELS]
    weave = np.where(((x // 4) + (y // 4)) % 2 == 0, 0.12, 0.0)
    return blend(
        color, thread, 0.25 + weave + 0.4 * noise(rng, (4, 4)) + 0.2 * noise(rng, (64, 64))
    )


def rug(rng: np.random.Generator, ground: Color, figure: Color) -> np.ndarray:
    """Draw a worn rug with nested diamonds."""
    y, x = np.mgrid[:TILE_TEXELS, :TILE_TEXELS]
    rings = (np.abs(x - 128) + np.abs(y - 128)) // 16 % 3 == 0
    return blend(ground, figure, 0.1 + 0.75 * rings + 0.35 * noise(rng, (16, 16)))


def books(rng: np.random.Generator) -> np.ndarray:
    """Draw book spines of different width, height and color in two rows."""
    tile = np.full((TILE_TEXELS, TILE_TEXELS, 3), 0.12)
    for bottom in (TILE_TEXELS // 2, TILE_TEXELS):
        left = 0
        while left < TILE_TEXELS:
            right = min(left + int(rng.integers(7, 18)), TILE_TEXELS)
            top = bottom - int(rng.integers(84, 118))
            spine = 0.12 + 0.5 * rng.random() + 0.3 * (rng.random(3) - 0.5)
            tile[top : bottom - 6, left : right - 1] = spine
            label = top + int(rng.integers(12, 40))
            tile[label : label + 10, left + 1 : right - 2] = 0.85 - 0.5 * spine
            left = right
        tile[bottom - 6 : bottom] = (0.45, 0.3, 0.18)
    return tile * (1 + 0.1 * noise(rng, (16, 16)))[..., None]


def painting(rng: np.random.Generator, palette: tuple[Color, ...]) -> np.ndarray:
    """Draw an abstract picture: layers of paint bounded by contours of noise."""
    tile = np.tile(np.array(palette[0]), (TILE_TEXELS, TILE_TEXELS, 1))
    for color in palette[1:]:
        covered = noise(rng, (3, 3), 5) > 0.12
        tile[covered] = np.array(color)
    return tile * (1 + 0.25 * noise(rng, (16, 16)))[..., None]


def leaves(rng: np.random.Generator, dark: Color, light: Color) -> np.ndarray:
    """Draw foliage: crisp light patches over dark ones."""
    return blend(dark, light, 0.5 + 2.0 * noise(rng, (16, 16), 4))
