"""Materials of the flat: a pool of random textures per kind, shared by all classes of objects."""

from dataclasses import dataclass

import numpy as np

from ldo_service.synthetic import textures
from ldo_service.synthetic.textures import TILE_TEXELS, Color, Texture, mipmapped

# Number of different textures of each kind.
KINDS = {"fabric": 8, "wood": 8, "plastic": 10, "metal": 5, "print": 6, "ceramic": 6, "leaves": 3}
KINDS |= {"books": 2, "picture": 5, "screen": 3}


@dataclass
class Materials:
    """Random choice of materials. A call with the kind "wood" returns a name like "wood 3"."""

    rng: np.random.Generator

    def __call__(self, kind: str) -> str:
        return f"{kind} {int(self.rng.integers(KINDS[kind]))}"


def materials(seed: int) -> dict[str, Texture]:
    """Return every texture of the flat by name; `seed` determines the textures."""
    rng = np.random.default_rng([seed, 1])
    painted = {f"{kind} {i}": _PAINTERS[kind](rng) for kind, n in KINDS.items() for i in range(n)}
    return painted | _building(rng)


def _building(rng: np.random.Generator) -> dict[str, Texture]:
    """Draw the textures of walls, ceiling and floors.

    Walls have weak texture, like real painted walls: a few percent around one tone.
    """
    tones: dict[str, Color] = {
        "wall_a": (0.84, 0.81, 0.75),
        "wall_b": (0.74, 0.79, 0.79),
        "wall_c": (0.82, 0.82, 0.79),
        "ceiling": (0.92, 0.91, 0.89),
    }
    walls = {name: _texture(_wall(rng, tone), 2.9) for name, tone in tones.items()}
    return walls | {
        "floor_a": _texture(textures.planks(rng, (0.72, 0.55, 0.38), (0.5, 0.35, 0.22)), 1.2),
        "floor_b": _texture(_tiles(rng), 1.32),
        "floor_c": _texture(textures.fabric(rng, (0.42, 0.43, 0.46), (0.58, 0.58, 0.58)), 1.4),
    }


def _texture(tile: np.ndarray, size_m: float) -> Texture:
    """Return the texture of a tile in single precision.

    Single precision halves the memory traffic and is far finer than the 8 bits of an image.
    """
    texture = mipmapped(tile, size_m)
    return Texture(texture.texels.astype(np.float32), texture.size_m)


def _wall(rng: np.random.Generator, tone: Color) -> np.ndarray:
    """Draw emulsion paint: soft clouds, roller grain and a few scuffs."""
    clouds = 0.045 * textures.noise(rng, (2, 2), 7) + 0.03 * textures.noise(rng, (64, 64), 2)
    scuffs = np.maximum(textures.noise(rng, (8, 8), 5) - 0.42, 0.0)
    return np.array(tone) * (1 + clouds - 0.35 * scuffs)[..., None]


def _tiles(rng: np.random.Generator) -> np.ndarray:
    """Draw stone tiles, four across, each with its own tone, with pale joints."""
    side = TILE_TEXELS // 4
    place = np.arange(TILE_TEXELS) // side
    tone = rng.random((4, 4))[place][:, place]
    edge = np.arange(TILE_TEXELS) % side < 2
    joint = edge[:, None] | edge[None, :]
    weight = 0.2 + 0.25 * tone + 0.35 * textures.noise(rng, (8, 8)) - 0.5 * joint
    return textures.blend((0.66, 0.64, 0.6), (0.36, 0.35, 0.34), weight)


def _color(rng: np.random.Generator, low: float = 0.08, high: float = 0.92) -> Color:
    """Return a random color of any hue; vivid colors are rare, as they are indoors."""
    value, saturation = low + (high - low) * rng.random(), rng.random()
    weak = value * (1 - 0.7 * saturation * saturation)
    hue = 6 * rng.random()
    r, g, b = (min(max(abs((hue + turn) % 6 - 3) - 1, 0.0), 1.0) for turn in (0, 4, 2))
    return tuple(weak + (value - weak) * part for part in (r, g, b))  # type: ignore[return-value]


def _plastic(rng: np.random.Generator) -> np.ndarray:
    tone = 1 + 0.1 * textures.noise(rng, (2, 2)) + 0.05 * textures.noise(rng, (32, 32), 3)
    return np.array(_color(rng)) * tone[..., None]


def _metal(rng: np.random.Generator) -> np.ndarray:
    """Draw brushed metal with fine lines along u."""
    tone = 1 + 0.12 * textures.noise(rng, (64, 2), 3) + 0.12 * textures.noise(rng, (2, 2))
    return np.array(_color(rng, 0.3, 0.75)) * tone[..., None]


def _ceramic(rng: np.random.Generator) -> np.ndarray:
    """Draw bands under glaze."""
    band = (np.arange(TILE_TEXELS) // 32 % 4 == 0)[:, None] * 0.8
    weight = band + 0.25 * textures.noise(rng, (4, 4))
    return textures.blend(_color(rng), _color(rng), weight)


def _screen(rng: np.random.Generator) -> np.ndarray:
    """Draw a dark panel with weak reflections."""
    return textures.blend((0.03, 0.03, 0.04), (0.16, 0.17, 0.2), textures.noise(rng, (2, 2), 6))


def _leaves(rng: np.random.Generator) -> np.ndarray:
    value = 0.2 + 0.3 * rng.random()
    return textures.leaves(rng, (0.3 * value, 0.5 * value, 0.25 * value), (value, 1.4 * value, 0.4))


_PAINTERS = {
    "fabric": lambda rng: _texture(textures.fabric(rng, _color(rng), _color(rng)), 0.8),
    "wood": lambda rng: _texture(textures.wood(rng, _color(rng, 0.4, 0.85), _color(rng)), 0.9),
    "plastic": lambda rng: _texture(_plastic(rng), 0.6),
    "metal": lambda rng: _texture(_metal(rng), 0.7),
    "print": lambda rng: _texture(textures.rug(rng, _color(rng), _color(rng)), 0.45),
    "ceramic": lambda rng: _texture(_ceramic(rng), 0.3),
    "leaves": lambda rng: _texture(_leaves(rng), 0.4),
    "books": lambda rng: _texture(textures.books(rng), 0.7),
    "picture": lambda rng: _texture(
        textures.painting(rng, tuple(_color(rng) for _ in range(4))), 0.7
    ),
    "screen": lambda rng: _texture(_screen(rng), 0.9),
}
