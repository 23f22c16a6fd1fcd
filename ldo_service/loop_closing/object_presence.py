"""Check of the relative pose of two subgraphs: both must show the same objects of the map.

Places with the same furniture have similar features and surfaces, but differ in some objects. If
the relative pose of two subgraphs is right, an object that one subgraph shows is also visible in
the other one, unless the object was moved. The object is missing if the other subgraph measures a
surface behind it, or if the images there do not show its pattern. These two tests need no
detections. If the subgraphs have objects with different labels at one place, the object was
replaced. Conventions: `ldo_service.geometry`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import cached_property, lru_cache, partial
from itertools import product

import numpy as np

from ldo_service.geometry import Camera, se3
from ldo_service.geometry.keyframe_poses import KeyframePoses
from ldo_service.semantics.distributions import divergence

from .object_images import (
    DEPTH_SIGMAS,
    MARGIN_M,
    MIN_SIGMA_M,
    NEAREST_M,
    RADIUS,
    PosedImage,
    compare_images,
    depth_sigma_m,
    smoothed,
)
from .subgraph import Subgraph, SubgraphKeyframe

RAYS = 64  # Rays to each object; a fraction of them has a standard error of at most 6 %.
# Minimum fraction of the rays to an object that hit it or pass through it. The other rays end in
# front of the object, outside of the image, or at a pixel without depth.
MIN_OBSERVED = 0.5
# An object is in a view if at most MAX_THROUGH of its rays pass through it, and it is missing if
# more than MIN_MISSING do. At right poses, at most a fraction of 0.2 passed through any object of
# the kitchen and of `synthetic:twins`.
MAX_THROUGH = 0.1
MIN_MISSING = 0.3
# An object is also missing if no two images of both places have at least this correlation, and
# one image has a contrast of at least MIN_CONTRAST gray levels, about twice the noise of a camera.
# Unrelated images have a correlation near 0. At right poses, the best one was at least 0.25 for
# 81 tests of the kitchen, and at least 0.36 for 1,758 tests of `synthetic:twins`, seeds 0 and 1.
MIN_CORRELATION = 0.2
MIN_CONTRAST = 8.0
# Two objects are at one place if the Bhattacharyya coefficient of their Gaussians is at
# least MIN_OVERLAP and neither overlaps more with another object. One replaces the
# other if the KL divergence of their labels is above REPLACED_NATS in both directions:
# a label that is certain for one object then has at most 5 % in the other. Because
# `divergence` clamps probabilities at 1e-6, two objects that share a label of 75 %
# count too if each has a label of 25 % that the other lacks. In maps of
# `synthetic:twins` with seeds 0 and 1, this holds for 1 of 60 pairs of objects that are
# equal except for their texture.
MIN_OVERLAP = 0.5
REPLACED_NATS = 3.0
# Largest fraction of the tests in which an object may be missing or replaced. The limit is the
# ratio at which two explanations are equally likely: the same place, where 1 % of the objects were
# moved or are badly mapped, and another place that shares 90 % of the objects:
#   log(0.99 / 0.9) / (log(0.99 / 0.9) + log(0.1 / 0.01)) = 0.04.
MAX_MISSING_RATIO = 0.04
CACHED_IMAGES = 16  # Decompressed images and depths in the cache, 0.6 MB a pair at 320x240.


@dataclass(frozen=True, eq=False)
class MapLandmarks:
    """Objects of the map as landmarks of loop closing.

    Attributes:
        p_map: Centroids in the map frame, [K, 3], meters.
        covariance: Covariances of the positions of the objects' Gaussians, [K, 3, 3], m^2.
        distributions: Label distributions over C labels, [K, C].
    """

    p_map: np.ndarray
    covariance: np.ndarray
    distributions: np.ndarray

    @staticmethod
    def none() -> "MapLandmarks":
        """Return an instance without landmarks."""
        return MapLandmarks(np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 1)))

    def __len__(self) -> int:
        return len(self.p_map)

    def __getitem__(self, which: np.ndarray) -> "MapLandmarks":
        """Return the landmarks that `which` selects, indices or mask."""
        return MapLandmarks(self.p_map[which], self.covariance[which], self.distributions[which])

    def moved(self, T: np.ndarray) -> "MapLandmarks":
        """Return the landmarks transformed by T [4, 4] from the map frame to another frame."""
        R = T[:3, :3]
        p = se3.transform(T, self.p_map)
        return MapLandmarks(p, R @ self.covariance @ R.T, self.distributions)

    def pack(self) -> dict[str, np.ndarray]:
        """Return a dictionary of the arrays by name; repeated calls return the same dictionary."""
        return self._packed

    @cached_property
    def _packed(self) -> dict[str, np.ndarray]:
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @staticmethod
    def unpack(kept: dict[str, np.ndarray] | None) -> "MapLandmarks":
        """Return the landmarks that `pack` packed; None gives an instance without landmarks."""
        return MapLandmarks(**kept) if kept else MapLandmarks.none()


@dataclass(frozen=True, slots=True)
class ObjectPresence:
    """Result of checking a relative pose of two subgraphs by the objects that they show."""

    tested: int  # Number of tests; an object that both subgraphs show counts twice.
    missing: int  # Number of tests in which the object is missing.
    replaced: int  # Number of pairs of objects with different labels at one place.

    @property
    def contradicts(self) -> bool:
        """True if `missing` + `replaced` exceeds the fraction `MAX_MISSING_RATIO` of `tested`."""
        return self.missing + self.replaced > MAX_MISSING_RATIO * self.tested


def _unit_ball() -> np.ndarray:
    """Return `RAYS` points in the unit ball, [S, 3]; every call returns the same points."""
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(RAYS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return directions * np.cbrt(rng.random((RAYS, 1)))


BALL = _unit_ball()


def ray_fractions(
    objects: MapLandmarks, depth_m: np.ndarray, camera: Camera
) -> tuple[np.ndarray, np.ndarray]:
    """Return the fraction of rays that hit each object, and the fraction that pass through it.

    An object is an ellipsoid with a radius of `RADIUS` standard deviations. Rays go from the camera
    to points within one standard deviation of the centroid. A ray enters the ellipsoid at the depth
    z0 and leaves it at the depth z1. At the pixel of the ray, z is the measured depth, and `gate`
    is the tolerance for depth noise and pose errors:

        z < z0 - gate                  a surface in front of the object: no information
        z0 - gate <= z <= z1 + gate    the ray hits the object
        z > z1 + gate                  the ray passes through the object

    Args:
        objects: K objects in camera coordinates.
        depth_m: Depth image, [H, W], meters; 0 where unknown.
        camera: Intrinsics of the depth image.

    Returns:
        Fractions of the rays that hit, [K], and that pass through, [K].
    """
    spread = np.linalg.cholesky(objects.covariance + MIN_SIGMA_M**2 * np.eye(3))
    points = objects.p_map[:, None] + BALL @ np.swapaxes(spread, 1, 2)
    is_ahead = points[..., 2] > NEAREST_M
    points = np.where(is_ahead[..., None], points, [0.0, 0.0, 1.0])
    pixels = np.rint(camera.project(points.reshape(-1, 3))).astype(np.int64)
    u, v = np.moveaxis(pixels.reshape(*points.shape[:2], 2), 2, 0)
    is_inside = is_ahead & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    z = np.where(is_inside, depth_m[np.where(is_inside, v, 0), np.where(is_inside, u, 0)], 0.0)
    # The points of a ray are z d. In whitened coordinates, the ellipsoid is |z d - c| = RADIUS.
    whitening = np.swapaxes(np.linalg.inv(spread), 1, 2)
    d = points / points[..., 2:] @ whitening
    c = objects.p_map[:, None] @ whitening
    dd, dc, cc = np.sum(d * d, axis=2), np.sum(d * c, axis=2), np.sum(c * c, axis=2)
    half_m = np.sqrt(np.maximum(dc**2 - dd * (cc - RADIUS**2), 0)) / dd
    gate_m = MARGIN_M + DEPTH_SIGMAS * depth_sigma_m(z)
    is_through = (z > 0) & (z > dc / dd + half_m + gate_m)
    is_hit = (z > 0) & (z >= dc / dd - half_m - gate_m) & ~is_through
    return is_hit.mean(axis=1), is_through.mean(axis=1)


class ObjectPresenceChecker:
    """Check of the relative pose of two subgraphs by objects, with a cache of recent images."""

    def __init__(self) -> None:
        self._depth_m = lru_cache(CACHED_IMAGES)(lambda view: view.place.depth_m)
        self._gray = lru_cache(CACHED_IMAGES)(lambda view: smoothed(view.place.gray_image))

    def check(
        self,
        objects: MapLandmarks,
        old: Subgraph,
        new: Subgraph,
        T_there_new: np.ndarray,
        poses: KeyframePoses,
    ) -> ObjectPresence:
        """Search the views of each of two subgraphs for the objects that the other one shows.

        Objects may have a wrong position in the map, for example before a correction. Such an
        object is not visible in its own subgraph at this position, and is therefore not tested.

        Args:
            objects: Objects in the map frame.
            old: Old subgraph.
            new: New subgraph.
            T_there_new: Transform [4, 4] in the map frame by which a loop hypothesis moves the new
                subgraph.
            poses: Poses of keyframes in the map; views without a pose are ignored.
        """
        views = [
            [view for view in subgraph.views if view.keyframe in poses] for subgraph in (old, new)
        ]
        T_map = [np.array([poses[v.keyframe] for v in of]).reshape(-1, 4, 4) for of in views]
        motions = se3.inverse(T_there_new), T_there_new
        tested = missing = 0
        present = []
        for shows, other in ((0, 1), (1, 0)):
            T_other = motions[other] @ T_map[other]
            here = self._fractions(objects, views[shows], T_map[shows])
            hit, through = here.sum(axis=0)
            is_shown = (hit > 0) & (through <= MAX_THROUGH * (hit + through))
            shown = objects[is_shown]
            there = self._fractions(shown, views[other], T_other)
            hit, through = there.sum(axis=0)
            is_missing = through > MIN_MISSING * (hit + through)
            pairs = here[:, 0, is_shown], there[:, 0]
            images = self._posed(views[shows], T_map[shows]), self._posed(views[other], T_other)
            for k in np.flatnonzero((hit > 0) & ~is_missing).tolist():
                is_missing[k] = _looks_different(shown, k, images, (pairs[0][:, k], pairs[1][:, k]))
            tested += int(np.count_nonzero(hit + through))
            missing += int(np.count_nonzero(is_missing))
            present.append(shown[(hit > 0) & ~is_missing])
        return ObjectPresence(
            tested, missing, count_replaced(present[0], present[1].moved(T_there_new))
        )

    def _posed(
        self, views: Sequence[SubgraphKeyframe], T_map_views: np.ndarray
    ) -> list[Callable[[], PosedImage]]:
        """Return a function for each view that decompresses its image."""
        return [
            partial(self._image, view, T_map_view)
            for view, T_map_view in zip(views, T_map_views, strict=True)
        ]

    def _image(self, view: SubgraphKeyframe, T_map_view: np.ndarray) -> PosedImage:
        return PosedImage(self._gray(view), self._depth_m(view), view.place.camera, T_map_view)

    def _fractions(
        self, objects: MapLandmarks, views: Sequence[SubgraphKeyframe], T_map_views: np.ndarray
    ) -> np.ndarray:
        """Return the fractions of `ray_fractions` in each of V views, [V, 2, K].

        They are 0 in views that do not show the object.
        """
        fractions = np.zeros((len(views), 2, len(objects)))
        for k, (view, T_map_view) in enumerate(zip(views, T_map_views, strict=True)):
            seen = objects.moved(se3.inverse(T_map_view))
            near = np.flatnonzero(_are_in_view(seen.p_map, view.place.camera))
            if len(near):
                camera = view.place.camera
                one = np.array(ray_fractions(seen[near], self._depth_m(view), camera))
                fractions[k][:, near] = np.where(one.sum(axis=0) > MIN_OBSERVED, one, 0)
        return fractions


def _looks_different(
    objects: MapLandmarks,
    k: int,
    images: tuple[list[Callable[[], PosedImage]], list[Callable[[], PosedImage]]],
    hits: tuple[np.ndarray, np.ndarray],
) -> bool:
    """Return whether no image of the object `k` at one place correlates with one at the other.

    The images that show most of the object come first. An object without comparable images does
    not look different.

    Args:
        objects: Objects.
        k: Index of the object.
        images: Images of both places.
        hits: Fractions of the rays that hit the object in each of these images.
    """
    has_pattern = False
    orders = [[int(v) for v in np.argsort(-hit, kind="stable") if hit[v] > 0] for hit in hits]
    for a, b in product(*orders):
        found = compare_images(
            objects.p_map[k], objects.covariance[k], images[0][a](), images[1][b]()
        )
        if found is not None and found.correlation >= MIN_CORRELATION:
            return False
        has_pattern |= found is not None and found.contrast >= MIN_CONTRAST
    return has_pattern


def count_replaced(a: MapLandmarks, b: MapLandmarks) -> int:
    """Count the pairs of objects that are at the same place but have different labels.

    Args:
        a: Objects of one subgraph.
        b: Objects of the other subgraph, in the same frame as `a`.
    """
    if not len(a) or not len(b):
        return 0
    overlaps = _overlaps(a, b)
    best = overlaps.argmax(axis=1)
    rows = np.arange(len(a))
    is_pair = (overlaps.argmax(axis=0)[best] == rows) & (overlaps[rows, best] >= MIN_OVERLAP)
    p, q = a.distributions[is_pair], b.distributions[best[is_pair]]
    nats = np.minimum(divergence(p, q), divergence(q, p))
    return int(np.count_nonzero(nats > REPLACED_NATS))


def _overlaps(a: MapLandmarks, b: MapLandmarks) -> np.ndarray:
    """Return the Bhattacharyya coefficient of each pair of objects as Gaussians, [K, L].

        BC = (|A| |B|)^(1/4) / |M|^(1/2) exp(-d' M^-1 d / 8),  M = (A + B) / 2

    The coefficient is computed for pairs that are near each other; it is 0 for the other pairs,
    whose coefficient is below `MIN_OVERLAP`. The first factor is at most 1, and d' M^-1 d is at
    least |d|^2 divided by the mean of the largest eigenvalues of A and B.
    """
    small = MIN_SIGMA_M**2 * np.eye(3)
    A, B = a.covariance + small, b.covariance + small
    largest = [np.linalg.eigvalsh(C)[:, -1] for C in (A, B)]
    # Inner products take less memory than the [K, L, 3] differences.
    squares = [np.sum(one.p_map**2, axis=1) for one in (a, b)]
    gap2 = squares[0][:, None] + squares[1] - 2 * a.p_map @ b.p_map.T
    limit2 = -4 * np.log(MIN_OVERLAP) * (largest[0][:, None] + largest[1])
    rows, columns = np.nonzero(gap2 <= limit2)
    A, B = A[rows], B[columns]
    M, d = (A + B) / 2, a.p_map[rows] - b.p_map[columns]
    exponent = np.einsum("pi,pij,pj->p", d, np.linalg.inv(M), d) / 8
    sizes = (np.linalg.det(A) * np.linalg.det(B)) ** 0.25 / np.sqrt(np.linalg.det(M))
    overlaps = np.zeros((len(a), len(b)))
    overlaps[rows, columns] = sizes * np.exp(-exponent)
    return overlaps


def _are_in_view(p_camera: np.ndarray, camera: Camera) -> np.ndarray:
    """Return which points [K, 3] lie in the image or at most a fifth of its size beside it."""
    z = np.maximum(p_camera[:, 2], NEAREST_M)
    u, v = camera.fx * p_camera[:, 0] / z + camera.cx, camera.fy * p_camera[:, 1] / z + camera.cy
    u, v = u / camera.width, v / camera.height
    return (p_camera[:, 2] > NEAREST_M) & (u > -0.2) & (u < 1.2) & (v > -0.2) & (v < 1.2)
