"""Conversions between messages and numerics: detections, regions, objects and distributions."""

from collections.abc import Callable, Sequence

import numpy as np

from ldo_service.detection.detectors import Detections
from ldo_service.detection.dynamic_classes import Box as MovableBox
from ldo_service.detection.vocabulary import Vocabulary
from ldo_service.regions.foreground import RegionDetections
from ldo_service.regions.region import Region
from ldo_service.schemas import (
    Detection,
    DetectionBoxes,
    GraphLandmark,
    Image,
    Keyframe,
    LabelRequest,
    MapObject,
    ObjectObservation,
    ObjectView,
)
from ldo_service.schemas.objects import Box, Distribution
from ldo_service.semantics.distributions import entropy, sparse
from ldo_service.semantics.object_landmarks import distributions, labels_of
from ldo_service.semantics.objects import ObjectUpdate

from .poses import pose_to_message


def detections_to_message(
    keyframe: Keyframe, found: Detections | None, labels: Sequence[str], network: str
) -> DetectionBoxes:
    """What a network found in a keyframe; `labels` are the names of its classes. None: it did not
    look."""
    rows = () if found is None else zip(found.boxes_px, found.scores, found.class_ids, strict=True)
    return DetectionBoxes(
        stamp_ns=keyframe.stamp_ns,
        keyframe=keyframe.keyframe,
        width=keyframe.camera.width,
        height=keyframe.camera.height,
        detections=tuple(
            Detection(
                label=labels[int(class_id)], score=float(score), box_px=tuple(box_px.tolist())
            )
            for box_px, score, class_id in rows
        ),
        network="" if found is None else network,
    )


def detections_from_message(message: DetectionBoxes, vocabulary: Vocabulary) -> RegionDetections:
    """What the detector says; new names get an index."""
    found = message.detections
    return RegionDetections.of_detector(
        np.array([one.box_px for one in found], np.float32).reshape(-1, 4),
        np.array([vocabulary.index(one.label) for one in found], np.int64),
        np.array([one.score for one in found], np.float32),
    )


def label_request_to_message(region: Region, stamp_ns: int) -> LabelRequest:
    """What is asked about a region; `stamp_ns` is that of its newest keyframe."""
    crops = (
        Image(encoding="jpeg", width=v.width, height=v.height, data=memoryview(v.jpeg))
        for v in region.views
    )
    return LabelRequest(
        stamp_ns=stamp_ns,
        region=region.id,
        keyframe=region.keyframe,
        box_px=region.box_px,
        crops=tuple(crops),
        label=region.label,
        score=region.score,
    )


def landmark_to_message(
    landmark: int, centroid: np.ndarray, p: np.ndarray, names: Sequence[str]
) -> GraphLandmark:
    """`names` of the classes that have been seen; what `p` [C] gives to others is on none."""
    return GraphLandmark(
        object=landmark,
        centroid=_vector3(centroid),
        distribution=_distribution_to_message(p[: len(names)], names),
        entropy=max(float(entropy(p)), 0.0),
    )


def dense_distribution(
    distribution: Distribution, index: Callable[[str], int], classes: int
) -> np.ndarray:
    """[C], sums to one; `index` of a name. What is missing from one belongs to `other`."""
    p = np.zeros(classes)
    for name, weight in (*distribution, ("other", 1 - sum(w for _, w in distribution))):
        p[index(name)] += max(weight, 0.0)
    return p / p.sum()


def map_objects(table: np.ndarray, names: Sequence[str]) -> tuple[MapObject, ...]:
    """Of landmarks [K], in their order."""
    p = distributions(table)
    columns = zip(table, labels_of(table).tolist(), p, entropy(p).tolist(), strict=True)
    return tuple(_object_to_message(*column, names) for column in columns)


def _object_to_message(
    landmark: np.void, label: int, p: np.ndarray, entropy: float, names: Sequence[str]
) -> MapObject:
    T, views = landmark["T_map_object"], landmark["view_keyframes"]
    return MapObject(
        id=int(landmark["id"]),
        name=names[label],
        confidence=min(float(p[label]), 1.0),
        centroid=_vector3(landmark["centroid"]),
        covariance=tuple(landmark["covariance"].ravel().tolist()),
        T_map_object=pose_to_message(T),
        size=_vector3(landmark["size"]),
        distribution=_distribution_to_message(p, names),
        entropy=max(entropy, 0.0),
        observation_count=int(landmark["seen"]),
        miss_count=int(landmark["missed"]),
        first_keyframe=int(landmark["first"]),
        last_keyframe=int(landmark["last"]),
        views=tuple(
            ObjectView(keyframe=int(views[i]), box_px=_box(landmark["view_boxes"][i]))
            for i in np.flatnonzero(views >= 0)
        ),
    )


def observations_to_messages(
    observed: ObjectUpdate, names: Sequence[str], keyframe: int, stamp_ns: int
) -> list[ObjectObservation]:
    """What a keyframe shows of objects, and what it misses."""
    return [
        ObjectObservation(
            stamp_ns=stamp_ns,
            keyframe=keyframe,
            object=seen.object,
            box_px=_box(seen.box),
            distribution=_distribution_to_message(seen.distribution, names),
            entropy=max(float(seen.entropy), 0.0),
            is_miss=seen.is_miss,
        )
        for seen in observed.observations
    ]


def _distribution_to_message(p: np.ndarray, names: Sequence[str]) -> Distribution:
    labels, weights = sparse(p)
    pairs = zip(labels, weights, strict=True)
    return tuple((names[int(label)], float(weight)) for label, weight in pairs if weight > 0)


def _vector3(v: np.ndarray) -> tuple[float, float, float]:
    x, y, z = v.tolist()
    return x, y, z


def _box(box: np.ndarray) -> Box:
    x0, y0, x1, y1 = box.tolist()
    return x0, y0, x1, y1


def scale_boxes(detections: Sequence[Detection], times: float) -> list[MovableBox]:
    """Detections as edges of pixels, in an image that is so many times smaller."""
    return [
        MovableBox(one.label, *((edge + 0.5) / times for edge in one.box_px)) for one in detections
    ]
