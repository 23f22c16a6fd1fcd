"""Conversions between messages and internal types: detections, regions, objects, distributions."""

from collections.abc import Callable, Collection, Sequence

import numpy as np

from ldo_service.detection.detectors import Detections
from ldo_service.detection.dynamic_classes import Box as MovableBox
from ldo_service.detection.vocabulary import Vocabulary
from ldo_service.loop_closing.object_presence import MapLandmarks
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
    MapObjects,
    ObjectObservation,
    ObjectView,
)
from ldo_service.schemas.objects import Box, Distribution
from ldo_service.semantics.distributions import entropy, sparse
from ldo_service.semantics.object_landmarks import distributions, labels_of
from ldo_service.semantics.observations import ObjectUpdate

from .poses import pose_to_message


def detections_to_message(
    keyframe: Keyframe, found: Detections | None, labels: Sequence[str], network: str
) -> DetectionBoxes:
    """Return the message of the detections in a keyframe.

    Args:
        keyframe: The keyframe.
        found: Detections; None if the network did not run.
        labels: Names of the network's classes.
        network: Name of the network.
    """
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
    """Return the detections of a message, and add their unknown labels to the vocabulary."""
    found = message.detections
    return RegionDetections.of_detector(
        np.array([one.box_px for one in found], np.float32).reshape(-1, 4),
        np.array([vocabulary.index(one.label) for one in found], np.int64),
        np.array([one.score for one in found], np.float32),
    )


def label_request_to_message(region: Region, stamp_ns: int) -> LabelRequest:
    """Return the label request of a region.

    Args:
        region: The region.
        stamp_ns: Stamp of the newest keyframe in which the region was observed.
    """
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
    """Return the message of a landmark of the pose graph.

    Args:
        landmark: Id of the object.
        centroid: Centroid of the object in the map, [3] meters.
        p: Distribution over the classes, [C]. Only classes that have a name are in the message.
        names: Names of the classes in the order of `p`, at most C. Classes without a name were
            never observed.
    """
    return GraphLandmark(
        object=landmark,
        centroid=_vector3(centroid),
        distribution=_distribution_to_message(p[: len(names)], names),
        entropy=max(float(entropy(p)), 0.0),
    )


def dense_distribution(
    distribution: Distribution, index: Callable[[str], int], classes: int
) -> np.ndarray:
    """Return the distribution of a message as a vector [C] that sums to 1.

    Args:
        distribution: Pairs of label and probability. If the probabilities sum to less than 1, the
            rest is assigned to the class `other`.
        index: Function from a label to the index of its class.
        classes: Number of classes C.
    """
    p = np.zeros(classes)
    for name, weight in (*distribution, ("other", 1 - sum(w for _, w in distribution))):
        p[index(name)] += max(weight, 0.0)
    return p / p.sum()


def map_objects(table: np.ndarray, names: Sequence[str]) -> tuple[MapObject, ...]:
    """Convert a table of K objects to K messages in the same order.

    Args:
        table: The objects, [K] records; see `semantics.object_landmarks`.
        names: Names of the classes, by index.
    """
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


def landmarks_from_message(message: MapObjects, movable: Collection[str]) -> MapLandmarks:
    """Return the objects of a message as landmarks for loop closing.

    Args:
        message: The message.
        movable: Names of the classes that move by themselves; objects of these classes are omitted.
    """
    objects = [one for one in message.objects if one.name not in movable]
    names = sorted({name for one in objects for name, _ in one.distribution} | {"other"})
    index = {name: k for k, name in enumerate(names)}
    return MapLandmarks(
        np.array([one.centroid for one in objects], float).reshape(-1, 3),
        np.array([one.covariance for one in objects], float).reshape(-1, 3, 3),
        np.array(
            [dense_distribution(one.distribution, index.__getitem__, len(names)) for one in objects]
        ).reshape(-1, len(names)),
    )


def observations_to_messages(
    observed: ObjectUpdate, names: Sequence[str], keyframe: int, stamp_ns: int
) -> list[ObjectObservation]:
    """Return the messages of the observations and misses of objects in a keyframe.

    Args:
        observed: Observations and misses of the keyframe.
        names: Names of the classes, by index.
        keyframe: Id of the keyframe.
        stamp_ns: Stamp of the keyframe.
    """
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
    """Convert the boxes of detections to a smaller image.

    Args:
        detections: Detections, in pixels of the original image.
        times: Size of the original image divided by the size of the smaller one.

    Returns:
        Boxes in pixels of the smaller image. Their origin is the corner of the first pixel, while
        the origin of the detections is the center of the first pixel.
    """
    return [
        MovableBox(one.label, *((edge + 0.5) / times for edge in one.box_px)) for one in detections
    ]
