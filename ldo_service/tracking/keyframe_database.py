"""Database of compressed keyframes for relocalization and keyframe reuse.

A record contains a thumbnail of the keyframe and its strongest ORB features with their 3D points.
It also contains the compressed gray image and depth at working resolution. The keyframe is rebuilt
from these images when frames are aligned to it again. Conventions: `ldo_service.geometry`.
"""

from collections.abc import Sequence, Set
from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property
from statistics import median
from typing import Any

import cv2
import numpy as np

from ldo_service.calibration.correction import CorrectionChange
from ldo_service.errors import ConfigError, named
from ldo_service.geometry import Camera, codecs, se3

from .features import FeatureConfig, Features, detect, detect_sift
from .keyframes import ReferenceKeyframe
from .motion import image_motions_rad
from .motion_segmentation import resized
from .pyramid import Pyramid, PyramidConfig, build_pyramid
from .tracking_quality import ResidualHistory

# Columns and rows of a thumbnail. It is so coarse that a camera motion of 10 cm changes it little.
THUMBNAIL = 20, 15
# Thumbnail values per standard deviation of gray. Sums of 300 int8 products are exact in float32.
CONTRAST = 32.0
# 16 bits reach 32 m in steps of half a millimeter, which is below the noise of any sensor.
DEPTH_STEPS_PER_M = 2000.0
NO_PAST = ResidualHistory()

DATABASE_FILE = "keyframe_database.msgpack"  # File name in the folder of a run.
OLD_DATABASE_FILE = "places.msgpack"  # File name up to version 0.1; read for one more version.


@dataclass(frozen=True, slots=True)
class KeyframeDatabaseConfig:
    """Settings of the keyframe database."""

    # Maximum number of records, 0.13 MB each at 640x480 (sequence kitchen). Beyond this number, the
    # record whose two neighbors on the path are closest to each other is removed.
    count: int = 1000
    # Maximum number of ORB features of a record: half of the number of a frame, to halve the
    # time of matching.
    features: int = 500
    # A new record replaces an older one within this distance (rad, as in
    # `motion.image_motion_rad`), because the new one shows the current state of the scene. The
    # value is half the distance between keyframes, so that the database stops growing while a
    # robot repeats its route.
    same: float = 0.1
    # Number of newest records that are never replaced, since new keyframes are measured against
    # them.
    recent: int = 16

    def __post_init__(self) -> None:
        if self.count < 3 or self.features < 1:
            raise ConfigError(
                named(self, "count", "features")
                + ": `count` must be at least 3, and `features` at least 1."
            )
        if self.same < 0 or self.recent < 0:
            raise ConfigError(
                named(self, "same", "recent") + ": `same` and `recent` must not be negative."
            )


@dataclass(frozen=True, eq=False)
class KeyframeRecord:
    """Compressed keyframe of about 130 kB."""

    id: int
    submap: int
    T_odom_keyframe: np.ndarray  # [4, 4]
    median_depth_m: float
    # Median photometric noise of the frames before the keyframe, gray levels; 0 if unknown.
    intensity_sigma: float
    # Median geometric noise of these frames as a multiple of `DepthNoise`; 0 if unknown.
    depth_noise_scale: float
    thumbnail: np.ndarray  # [300] int8 with mean 0 and normalized contrast; see `make_thumbnail`.
    points_camera: np.ndarray  # Points of the features, [N, 3] float32 meters; all are measured.
    descriptors: np.ndarray  # [N, 32] uint8 ORB descriptors.
    camera: Camera  # Intrinsics of `gray` and `depth`.
    gray: bytes  # PNG image of the size of `camera`.
    depth: bytes  # Depth of the size of `camera`, 16 bits compressed by zstd.
    # Change of the camera correction since the record was stored. Images and points are
    # converted when they are used, because a conversion of all records at once takes long.
    change: CorrectionChange | None = None

    @cached_property
    def features(self) -> Features:
        """ORB features of the keyframe, with pixel coordinates in the image of `camera`."""
        points, change = self.points_camera.astype(np.float64), self.change
        points = points if change is None else change.points(points, self.camera)
        return Features(self.camera.project(points), points, self.descriptors)

    def sift_features(self, config: FeatureConfig) -> Features:
        """Return at most `config.count_across_scales` / 2 SIFT features of the gray image.

        The features are detected on the first call and cached.
        """
        if "_across_scales" not in self.__dict__:
            image = self.gray_image, self.depth_m, self.camera
            seen = detect_sift(*image, config.count_across_scales // 2, config)
            self.__dict__["_across_scales"] = seen
        return self.__dict__["_across_scales"]

    def history(self, otherwise: ResidualHistory) -> ResidualHistory:
        """Return the usual residual noise near this keyframe, or `otherwise` if it is unknown.

        Alignments to this keyframe are compared with this noise, because noise differs between
        scenes.
        """
        if not self.intensity_sigma:
            return otherwise
        return ResidualHistory((self.intensity_sigma,), (self.depth_noise_scale,))

    def pack(self) -> dict[str, Any]:
        """Return the record as arrays and plain values; each call returns the same object."""
        return self._packed

    @cached_property
    def _packed(self) -> dict[str, Any]:
        kept = {field.name: getattr(self, field.name) for field in fields(self)}
        change = {} if self.change is None else {"change": self.change.pack()}
        del kept["change"]
        return {**kept, "camera": asdict(self.camera), **change}

    @staticmethod
    def unpack(kept: dict[str, Any]) -> "KeyframeRecord":
        """Return the record from its packed form.

        Records of version 0.1 have the key `segment` instead of `submap`.
        """
        values = {**kept, "camera": Camera.of(kept["camera"])}
        if "change" in values:
            values["change"] = CorrectionChange.of(values["change"])
        if "segment" in values:
            values["submap"] = values.pop("segment")
        return KeyframeRecord(**values)

    @property
    def nbytes(self) -> int:
        """Size of the arrays and compressed images in bytes."""
        arrays = (self.thumbnail, self.points_camera, self.descriptors, self.T_odom_keyframe)
        return sum(array.nbytes for array in arrays) + len(self.gray) + len(self.depth)

    def keyframe(self, config: PyramidConfig) -> ReferenceKeyframe:
        """Rebuild the keyframe, so that frames can be aligned to it.

        Every call returns bitwise the same images.
        """
        view = build_pyramid(self.gray_image, self.depth_m, self.camera, config)
        return ReferenceKeyframe(
            view, self.T_odom_keyframe, self.id, self.submap, stored_features=self.features
        )

    def without(self, ignore_mask: np.ndarray) -> "KeyframeRecord":
        """Return a copy of the record without the features, intensity and depth of masked pixels.

        Args:
            ignore_mask: Pixels to remove, [H, W] bool at the resolution of `camera`.
        """
        if not ignore_mask.any():
            return self
        points = self.features.points_camera
        kept = _are_still(points, self.camera, ignore_mask)
        return replace(
            self,
            points_camera=points[kept].astype(np.float32),
            descriptors=self.descriptors[kept],
            gray=_gray_bytes(self.gray_image, ignore_mask),
            depth=_depth_bytes(self.depth_m, ignore_mask),
            change=None,
        )

    def recorrected(self, change: CorrectionChange) -> "KeyframeRecord":
        """Return a copy of the record for a new correction of vignetting and depth bias."""
        return replace(self, change=change.after(self.change))

    @property
    def gray_image(self) -> np.ndarray:
        """Gray image [H, W] uint8; 0 where pixels are ignored."""
        png = np.frombuffer(self.gray, np.uint8)
        gray = np.asarray(cv2.imdecode(png, cv2.IMREAD_GRAYSCALE), np.uint8)
        return gray if self.change is None else self.change.gray(gray, self.camera)

    @property
    def depth_m(self) -> np.ndarray:
        """Depth [H, W] float32 in meters; 0 where unknown."""
        width, height = self.camera.width, self.camera.height
        steps = codecs.decode_depth("z16+zstd", width, height, memoryview(self.depth))
        depth_m = steps.astype(np.float32) / np.float32(DEPTH_STEPS_PER_M)
        return depth_m if self.change is None else self.change.depth_m(depth_m, self.camera)


def make_keyframe_record(
    keyframe: ReferenceKeyframe,
    features: FeatureConfig,
    config: KeyframeDatabaseConfig,
    history: ResidualHistory = NO_PAST,
) -> KeyframeRecord:
    """Compress a keyframe to a record, without the pixels of its ignore mask.

    Args:
        keyframe: The keyframe.
        features: Settings of ORB.
        config: Settings of the database.
        history: Noise of the frames before the keyframe. The medians of this noise are stored.
    """
    view, level = keyframe.view, keyframe.view.levels[0]
    ignore_mask = resized(keyframe.ignore_mask, level.depth_m.shape)
    seen = detect(view, replace(features, count=config.features))
    kept = _are_still(seen.points_camera, level.camera, ignore_mask)
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
        gray=_gray_bytes(np.rint(level.texels[..., 0]), ignore_mask),
        depth=_depth_bytes(level.depth_m, ignore_mask),
    )


def _gray_bytes(gray: np.ndarray, ignore_mask: np.ndarray) -> bytes:
    _, png = cv2.imencode(".png", np.where(ignore_mask, 0, gray).astype(np.uint8))
    return png.tobytes()


def _depth_bytes(depth_m: np.ndarray, ignore_mask: np.ndarray) -> bytes:
    steps = np.rint(depth_m * DEPTH_STEPS_PER_M)
    steps[ignore_mask | (steps > np.iinfo(np.uint16).max)] = 0
    return codecs.encode_depth(steps.astype(np.uint16))[1]


def _are_still(points: np.ndarray, camera: Camera, ignore_mask: np.ndarray) -> np.ndarray:
    """Return which points have a measured depth and project outside `ignore_mask`.

    Args:
        points: Points in the camera, [N, 3] meters; z = 0 where unmeasured.
        camera: Intrinsics of the mask.
        ignore_mask: Pixels to exclude, [H, W] bool.

    Returns:
        [N] bool.
    """
    kept = points[:, 2] > 0
    pixels = np.rint(camera.project(points[kept])).astype(int)
    column, row = np.clip(pixels, 0, [camera.width - 1, camera.height - 1]).T
    kept[kept] = ~ignore_mask[row, column]
    return kept


def make_thumbnail(view: Pyramid) -> np.ndarray:
    """Return a thumbnail of a frame, 20x15 pixels as [300] int8, with normalized contrast."""
    small = cv2.resize(view.gray, THUMBNAIL, interpolation=cv2.INTER_AREA).astype(np.float64)
    small -= small.mean()
    steps = CONTRAST * small / max(float(small.std()), 1.0)
    return np.rint(np.clip(steps, -127, 127)).astype(np.int8).reshape(-1)


@dataclass(frozen=True, eq=False)
class KeyframeDatabase:
    """Immutable sequence of keyframe records, the oldest first."""

    all: tuple[KeyframeRecord, ...] = ()

    def __len__(self) -> int:
        return len(self.all)

    def with_record(
        self, record: KeyframeRecord, config: KeyframeDatabaseConfig
    ) -> "KeyframeDatabase":
        """Return the database with a new record.

        The new record replaces the nearest older record if their poses differ by less than
        `config.same`. If the database then exceeds `config.count` records, one record is removed:
        the one whose previous and next record are closest to each other.
        """
        kept = (*self._others(record, config), record)
        if len(kept) > config.count:
            spare = int(np.argmin(neighbor_distances(kept))) + 1
            kept = (*kept[:spare], *kept[spare + 1 :])
        return KeyframeDatabase(kept)

    def with_reused(self, record: KeyframeRecord) -> "KeyframeDatabase":
        """Return the database with the record of a reused keyframe moved to the end.

        The given record has a new pose in odometry and replaces the record with the same id.
        """
        return KeyframeDatabase((*(other for other in self.all if other.id != record.id), record))

    def without(self, ignore_mask: np.ndarray, keyframe: int) -> "KeyframeDatabase":
        """Return the database with masked pixels removed from the record with the id `keyframe`."""
        records = (p.without(ignore_mask) if p.id == keyframe else p for p in self.all)
        return KeyframeDatabase(tuple(records))

    def recorrected(self, change: CorrectionChange) -> "KeyframeDatabase":
        """Return the database for a new correction of vignetting and depth bias."""
        return replace(self, all=tuple(record.recorrected(change) for record in self.all))

    def in_submap(self, submap: int, without: Set[int] = frozenset()) -> tuple[KeyframeRecord, ...]:
        """Return the records of a submap, except for the ids in `without`."""
        return tuple(p for p in self.all if p.submap == submap and p.id not in without)

    def _others(
        self, record: KeyframeRecord, config: KeyframeDatabaseConfig
    ) -> tuple[KeyframeRecord, ...]:
        """Return all records except the one that a new record replaces.

        The replaced record is the nearest one within the distance `config.same`. The newest
        `config.recent` records are never replaced.
        """
        older = self.all[: max(0, len(self.all) - config.recent)]
        if not older:
            return self.all
        apart = _apart(older, record)
        nearest = int(np.argmin(apart))
        if apart[nearest] >= config.same:
            return self.all
        return (*self.all[:nearest], *self.all[nearest + 1 :])

    def rank_by_similarity(self, view: Pyramid) -> list[int]:
        """Return the indices of all records; the thumbnail most similar to the frame is first."""
        correlations = self._thumbnails @ make_thumbnail(view).astype(np.float32)
        return np.argsort(-correlations, kind="stable").tolist()

    @cached_property
    def _thumbnails(self) -> np.ndarray:
        """Thumbnails [N, 300] as float32. Their values are integers, so correlations are exact."""
        return np.array([record.thumbnail for record in self.all], np.float32).reshape(
            -1, THUMBNAIL[0] * THUMBNAIL[1]
        )


def neighbor_distances(path: Sequence[KeyframeRecord]) -> np.ndarray:
    """Return the distance between the two neighbors of each record on the path.

    The first and the last record have only one neighbor and are left out.

    Args:
        path: N records in the order of the path.

    Returns:
        [N-2], rad, as `motion.image_motion_rad` defines it; infinite if the two neighbors are in
        different submaps.
    """
    median_depth_m = np.array([record.median_depth_m for record in path[1:-1]])
    apart = image_motions_rad(se3.inverse(_poses(path[:-2])) @ _poses(path[2:]), median_depth_m)
    submap = np.array([record.submap for record in path])
    return np.where(submap[:-2] == submap[2:], apart, np.inf)


def _apart(records: tuple[KeyframeRecord, ...], other: KeyframeRecord) -> np.ndarray:
    """Return the distance of each record to `other`.

    Returns:
        [N], rad, as `motion.image_motion_rad` defines it; infinite for records of another submap.
    """
    moved = se3.inverse(_poses(records)) @ other.T_odom_keyframe
    submap = np.array([record.submap for record in records])
    return np.where(submap == other.submap, image_motions_rad(moved, other.median_depth_m), np.inf)


def _poses(records: Sequence[KeyframeRecord]) -> np.ndarray:
    return np.array([record.T_odom_keyframe for record in records]).reshape(-1, 4, 4)
