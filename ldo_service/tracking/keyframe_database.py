"""Every keyframe, small enough to keep: where a lost camera may be. `ldo_service.geometry`.

A place is a keyframe's thumbnail, its strongest ORB features with their points, and its grey image
and depth at the working resolution, compressed: from these it can be tracked against again.
"""

from collections.abc import Sequence, Set
from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from statistics import median
from typing import Any

import cv2
import msgspec
import numpy as np

from ldo_service.errors import ConfigError, DataError
from ldo_service.geometry import Camera, codecs, se3
from ldo_service.storage.state_codec import decode_state

from .features import FeatureConfig, Features, detect, detect_sift
from .keyframes import ReferenceKeyframe
from .motion import image_motions_rad
from .motion_segmentation import resized
from .pyramid import Pyramid, PyramidConfig, build_pyramid
from .tracking_quality import ResidualHistory

THUMBNAIL = 20, 15  # columns, rows: so blurred that a hand's width of motion matters little
CONTRAST = 32.0  # steps per standard deviation; products of 300 int8 sum exactly in float32
DEPTH_STEPS_PER_M = 2000.0  # 16 bits reach 32 m in half millimetres, below any sensor's noise
NO_PAST = ResidualHistory()

DATABASE_FILE = "keyframe_database.msgpack"  # In the folder of a run.
OLD_DATABASE_FILE = "places.msgpack"  # Its name up to version 0.1, read for one more version.


@dataclass(frozen=True, slots=True)
class KeyframeDatabaseConfig:
    count: int = 1000  # places kept, 0.13 MB each at 640x480 (kitchen); then the path is thinned
    features: int = 500  # of each: half of a frame's, which halves the time to match
    same: float = 0.1  # rad, as `motion.extent`: a place so near is replaced by the newer one,
    # which shows it as it is now. Half a step between keyframes: on a round memory stops growing
    recent: int = 16  # last places, which are not replaced: new keyframes are measured against them

    def __post_init__(self) -> None:
        if self.count < 3 or self.features < 1:
            raise ConfigError("places.count must be at least 3 and places.features at least 1.")
        if self.same < 0 or self.recent < 0:
            raise ConfigError("places.same and places.recent must not be negative.")


@dataclass(frozen=True, eq=False)
class KeyframeRecord:
    """A keyframe in some 130 kB.

    thumbnail      [300] int8, of mean 0 and one contrast
    points_camera  [N, 3] float32 m, of the features; all were measured
    descriptors    [N, 32] uint8
    gray, depth    PNG and zstd, of `camera`'s size
    """

    id: int
    submap: int
    T_odom_keyframe: np.ndarray  # [4, 4]
    median_depth_m: float
    intensity_sigma: float  # of frames tracked before it, grey levels; 0: not known
    depth_noise_scale: float  # likewise, times the sensor model
    thumbnail: np.ndarray
    points_camera: np.ndarray
    descriptors: np.ndarray
    camera: Camera
    gray: bytes
    depth: bytes

    @cached_property
    def features(self) -> Features:
        points = self.points_camera.astype(np.float64)
        return Features(self.camera.project(points), points, self.descriptors)

    def sift_features(self, config: FeatureConfig) -> Features:
        """SIFT of the small image, detected when first asked for; half as many as of a frame."""
        if "_across_scales" not in self.__dict__:
            image = self._gray, self.depth_m, self.camera
            seen = detect_sift(*image, config.count_across_scales // 2, config)
            self.__dict__["_across_scales"] = seen
        return self.__dict__["_across_scales"]

    def history(self, otherwise: ResidualHistory) -> ResidualHistory:
        """What a frame that shows this place is judged by: scenes differ in noise."""
        if not self.intensity_sigma:
            return otherwise
        return ResidualHistory((self.intensity_sigma,), (self.depth_noise_scale,))

    def pack(self) -> dict[str, Any]:
        """Return arrays and plain values, the same object each time."""
        return self._packed

    @cached_property
    def _packed(self) -> dict[str, Any]:
        kept = {field.name: getattr(self, field.name) for field in fields(self)}
        return {**kept, "camera": asdict(self.camera)}

    @staticmethod
    def unpack(kept: dict[str, Any]) -> "KeyframeRecord":
        """The inverse of `pack`. A record of version 0.1 says `segment` for `submap`."""
        values = {**kept, "camera": Camera.of(kept["camera"])}
        if "segment" in values:
            values["submap"] = values.pop("segment")
        return KeyframeRecord(**values)

    @property
    def nbytes(self) -> int:
        arrays = (self.thumbnail, self.points_camera, self.descriptors, self.T_odom_keyframe)
        return sum(array.nbytes for array in arrays) + len(self.gray) + len(self.depth)

    def keyframe(self, config: PyramidConfig) -> ReferenceKeyframe:
        """The keyframe as frames can be aligned to it; bitwise equal each time."""
        view = build_pyramid(self._gray, self.depth_m, self.camera, config)
        return ReferenceKeyframe(
            view, self.T_odom_keyframe, self.id, self.submap, stored_features=self.features
        )

    def without(self, left_out: np.ndarray) -> "KeyframeRecord":
        """The same with nothing known of pixels [H, W] bool, at the size of its camera."""
        if not left_out.any():
            return self
        kept = _are_still(self.points_camera.astype(float), self.camera, left_out)
        return replace(
            self,
            points_camera=self.points_camera[kept],
            descriptors=self.descriptors[kept],
            gray=_gray_bytes(self._gray, left_out),
            depth=_depth_bytes(self.depth_m, left_out),
        )

    @property
    def _gray(self) -> np.ndarray:
        gray = cv2.imdecode(np.frombuffer(self.gray, np.uint8), cv2.IMREAD_GRAYSCALE)
        return np.asarray(gray, np.uint8)

    @property
    def depth_m(self) -> np.ndarray:
        width, height = self.camera.width, self.camera.height
        steps = codecs.decode_depth("z16+zstd", width, height, memoryview(self.depth))
        return steps.astype(np.float32) / np.float32(DEPTH_STEPS_PER_M)


def make_keyframe_record(
    keyframe: ReferenceKeyframe,
    features: FeatureConfig,
    config: KeyframeDatabaseConfig,
    history: ResidualHistory = NO_PAST,
) -> KeyframeRecord:
    """What is kept of a keyframe without what moves in it, and of the noise of frames before it."""
    view, level = keyframe.view, keyframe.view.levels[0]
    left_out = resized(keyframe.ignore_mask, level.depth_m.shape)
    seen = detect(view, replace(features, count=config.features))
    kept = _are_still(seen.points_camera, level.camera, left_out)
    return KeyframeRecord(
        id=keyframe.id,
        submap=keyframe.submap,
        T_odom_keyframe=keyframe.T_odom_keyframe,
        median_depth_m=keyframe.reference.median_depth_m,
        intensity_sigma=median(history.intensity_sigmas or (0.0,)),
        depth_noise_scale=median(history.depth_noise_scales or (0.0,)),
        thumbnail=make_thumbnail(view),
        points_camera=seen.points_camera[kept].astype(np.float32),
        descriptors=seen.descriptors[kept],
        camera=level.camera,
        gray=_gray_bytes(np.rint(level.texels[..., 0]), left_out),
        depth=_depth_bytes(level.depth_m, left_out),
    )


def _gray_bytes(gray: np.ndarray, left_out: np.ndarray) -> bytes:
    _, png = cv2.imencode(".png", np.where(left_out, 0, gray).astype(np.uint8))
    return png.tobytes()


def _depth_bytes(depth_m: np.ndarray, left_out: np.ndarray) -> bytes:
    steps = np.rint(depth_m * DEPTH_STEPS_PER_M)
    steps[left_out | (steps > np.iinfo(np.uint16).max)] = 0
    return codecs.encode_depth(steps.astype(np.uint16))[1]


def _are_still(points: np.ndarray, camera: Camera, left_out: np.ndarray) -> np.ndarray:
    """Which of points [N, 3] bool were measured, on what does not move."""
    kept = points[:, 2] > 0
    pixels = np.rint(camera.project(points[kept])).astype(int)
    column, row = np.clip(pixels, 0, [camera.width - 1, camera.height - 1]).T
    kept[kept] = ~left_out[row, column]
    return kept


def make_thumbnail(view: Pyramid) -> np.ndarray:
    """[300] int8: the image in 20x15, free of brightness and contrast."""
    small = cv2.resize(view.gray, THUMBNAIL, interpolation=cv2.INTER_AREA).astype(np.float64)
    small -= small.mean()
    steps = CONTRAST * small / max(float(small.std()), 1.0)
    return np.rint(np.clip(steps, -127, 127)).astype(np.int8).reshape(-1)


@dataclass(frozen=True, eq=False)
class KeyframeDatabase:
    """Places along the path, the oldest first. Immutable: `with_record` makes another."""

    all: tuple[KeyframeRecord, ...] = ()

    def __len__(self) -> int:
        return len(self.all)

    def with_record(
        self, place: KeyframeRecord, config: KeyframeDatabaseConfig
    ) -> "KeyframeDatabase":
        """With one more, and without the one that it shows anew; where there are too many, one that
        leaves the smallest gap is gone."""
        kept = (*self._others(place, config), place)
        if len(kept) > config.count:
            spare = int(np.argmin(neighbor_distances(kept))) + 1
            kept = (*kept[:spare], *kept[spare + 1 :])
        return KeyframeDatabase(kept)

    def with_reused(self, place: KeyframeRecord) -> "KeyframeDatabase":
        """With a known one as the newest, where odometry has it now."""
        return KeyframeDatabase((*(other for other in self.all if other.id != place.id), place))

    def without(self, left_out: np.ndarray, keyframe: int) -> "KeyframeDatabase":
        """With nothing known of pixels [H, W] bool of one of them: see `KeyframeRecord.without`."""
        places = (p.without(left_out) if p.id == keyframe else p for p in self.all)
        return KeyframeDatabase(tuple(places))

    def in_submap(self, submap: int, without: Set[int] = frozenset()) -> tuple[KeyframeRecord, ...]:
        """Those of a submap but for some, by id."""
        return tuple(p for p in self.all if p.submap == submap and p.id not in without)

    def _others(
        self, place: KeyframeRecord, config: KeyframeDatabaseConfig
    ) -> tuple[KeyframeRecord, ...]:
        """All but the nearest of those that are the same place, the last ones aside."""
        older = self.all[: max(0, len(self.all) - config.recent)]
        if not older:
            return self.all
        apart = _apart(older, place)
        nearest = int(np.argmin(apart))
        if apart[nearest] >= config.same:
            return self.all
        return (*self.all[:nearest], *self.all[nearest + 1 :])

    def rank_by_similarity(self, view: Pyramid) -> list[int]:
        """Indices of all places, the one whose thumbnail correlates best first."""
        correlations = self._thumbnails @ make_thumbnail(view).astype(np.float32)
        return np.argsort(-correlations, kind="stable").tolist()

    @cached_property
    def _thumbnails(self) -> np.ndarray:
        """[N, 300] float32 of whole numbers: their products sum exactly in any order."""
        return np.array([place.thumbnail for place in self.all], np.float32).reshape(
            -1, THUMBNAIL[0] * THUMBNAIL[1]
        )


def neighbor_distances(path: Sequence[KeyframeRecord]) -> np.ndarray:
    """[N-2] rad: how far the neighbours of each inner place are apart, as `motion.extent`.

    Infinite where they are of two submaps.
    """
    median_depth_m = np.array([place.median_depth_m for place in path[1:-1]])
    apart = image_motions_rad(se3.inverse(_poses(path[:-2])) @ _poses(path[2:]), median_depth_m)
    submap = np.array([place.submap for place in path])
    return np.where(submap[:-2] == submap[2:], apart, np.inf)


def _apart(places: tuple[KeyframeRecord, ...], other: KeyframeRecord) -> np.ndarray:
    """[N] rad: how far each is from another one, as `motion.extent`; infinite in other submaps."""
    moved = se3.inverse(_poses(places)) @ other.T_odom_keyframe
    submap = np.array([place.submap for place in places])
    return np.where(submap == other.submap, image_motions_rad(moved, other.median_depth_m), np.inf)


def _poses(places: Sequence[KeyframeRecord]) -> np.ndarray:
    return np.array([place.T_odom_keyframe for place in places]).reshape(-1, 4, 4)


def load_keyframe_database(folder: Path) -> KeyframeDatabase:
    """Of the map that a finished run left in its folder. Raises DataError when it left none."""
    files = [folder / name for name in (DATABASE_FILE, OLD_DATABASE_FILE)]
    path = next((file for file in files if file.is_file()), None)
    if path is None:
        raise DataError(
            f"{folder} has no {DATABASE_FILE}, so nothing can be localized in it. Name the folder "
            "that `ldo run SOURCE --out DIR` wrote; one of an older version has to be run again."
        )
    try:
        kept = decode_state(path.read_bytes())
        places = KeyframeDatabase(tuple(KeyframeRecord.unpack(place) for place in kept["places"]))
    except OSError as error:
        raise DataError(f"{path} cannot be read: {error.strerror}.") from error
    except (msgspec.DecodeError, ValueError, KeyError, TypeError) as error:
        raise DataError(f"{path} is not what `ldo run` writes: {error!r}. Run it again.") from error
    if not len(places):
        raise DataError(f"{path} holds no place: the run made no keyframe. Run it again.")
    return places
