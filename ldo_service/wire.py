"""Between messages and numerics: the one place that knows both."""

from collections.abc import Callable, Iterable, Mapping, Sequence

import cv2
import numpy as np

from ldo_service.detection.detectors import Detections
from ldo_service.detection.dynamic_classes import Box as MovableBox
from ldo_service.detection.vocabulary import Vocabulary
from ldo_service.geometry import Camera, RawFrame, RgbdFrame, codecs, se3
from ldo_service.geometry.keyframe_poses import RelativePose
from ldo_service.geometry.se3 import quaternions
from ldo_service.loops import Finding
from ldo_service.regions.foreground import Claims
from ldo_service.regions.region import Region
from ldo_service.schemas import (
    Array,
    CameraModel,
    CameraRgbd,
    Correction,
    Detection,
    DetectionBoxes,
    FrameRgbd,
    GraphLandmark,
    Image,
    Keyframe,
    LabelRequest,
    LoopCandidate,
    LoopClosure,
    MapObject,
    MeasuredPose,
    ObjectObservation,
    ObjectView,
    Pose,
)
from ldo_service.schemas.frames import ImageEncoding
from ldo_service.schemas.keyframe import NO_MASK
from ldo_service.schemas.objects import Box, Distribution
from ldo_service.semantics.distributions import entropy, sparse
from ldo_service.semantics.object_landmarks import distributions, labels_of
from ldo_service.semantics.objects import Observed
from ldo_service.tracking.keyframes import Keyframe as TrackedKeyframe
from ldo_service.tracking.moving import resized
from ldo_service.tracking.pyramid import PyramidConfig, pyramid_of


def pose_message(T: np.ndarray) -> Pose:
    """T [4, 4] for the wire."""
    x, y, z = (float(v) for v in T[:3, 3])
    qw, qx, qy, qz = (float(v) for v in se3.quaternion(T[:3, :3]))
    return Pose((x, y, z), (qw, qx, qy, qz))


def transform(pose: Pose) -> np.ndarray:
    """T [4, 4] of a pose from the wire."""
    return se3.from_quaternion(np.array(pose.translation), np.array(pose.quaternion))


def matrix6_message(matrix: np.ndarray) -> tuple[float, ...]:
    return tuple(float(v) for v in np.asarray(matrix).ravel())


def measured_message(measured: RelativePose) -> MeasuredPose:
    return MeasuredPose(
        reference=measured.a,
        keyframe=measured.b,
        T_reference_keyframe=pose_message(measured.T_a_b),
        information=matrix6_message(measured.information),
    )


def measured_of(message: MeasuredPose) -> RelativePose:
    return RelativePose(
        message.reference,
        message.keyframe,
        transform(message.T_reference_keyframe),
        np.array(message.information).reshape(6, 6),
    )


def measurements_of(keyframe: Keyframe) -> list[RelativePose]:
    """All that a keyframe was measured from, its reference first; none for the first keyframe."""
    window = [measured_of(pose) for pose in keyframe.window]
    if keyframe.reference is None:
        return window
    T_reference_keyframe = transform(keyframe.T_reference_keyframe)
    information = np.array(keyframe.information).reshape(6, 6)
    first = RelativePose(keyframe.reference, keyframe.keyframe, T_reference_keyframe, information)
    return [first, *window]


def camera_message(camera: Camera) -> CameraModel:
    return CameraModel(
        width=camera.width,
        height=camera.height,
        fx=camera.fx,
        fy=camera.fy,
        cx=camera.cx,
        cy=camera.cy,
        distortion=camera.distortion,
    )


def camera_of(model: CameraModel) -> Camera:
    return Camera(
        model.width, model.height, model.fx, model.fy, model.cx, model.cy, model.distortion
    )


def rgbd_message(frame: RgbdFrame) -> FrameRgbd:
    return FrameRgbd(
        stamp_ns=frame.stamp_ns,
        frame=frame.index,
        camera=camera_message(frame.camera),
        color=Array.of(frame.color),
        depth_m=Array.of(frame.depth_m),
    )


def rgbd_of(message: FrameRgbd | Keyframe) -> RgbdFrame:
    """The frame of a message; its arrays are read-only views."""
    return RgbdFrame(
        color=message.color.numpy(),
        depth_m=message.depth_m.numpy(),
        camera=camera_of(message.camera),
        stamp_ns=message.stamp_ns,
        index=message.frame,
    )


def keyframe_of(message: Keyframe, config: PyramidConfig) -> TrackedKeyframe:
    """A keyframe that others can be aligned to, without what moves in it."""
    view = pyramid_of(rgbd_of(message), config)
    return TrackedKeyframe(
        view,
        transform(message.T_odom_keyframe),
        message.keyframe,
        message.segment,
        left_out=resized(mask_of(message.is_moving), view.levels[0].depth_m.shape),
    )


def mask_message(mask: np.ndarray | None, camera: Camera) -> Array:
    """A mask [h, w] bool of any size as u1 [H, W] of the camera's; [0, 0] where nothing is set."""
    if mask is None or not mask.any():
        return NO_MASK
    size = camera.width, camera.height
    return Array.of(cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST))


def mask_of(array: Array) -> np.ndarray | None:
    """[H, W] bool; None where there is none."""
    return array.numpy() > 0 if array.data.nbytes else None


def boxes_message(
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


def claims_of(message: DetectionBoxes, vocabulary: Vocabulary) -> Claims:
    """What the detector says; new names get an index."""
    found = message.detections
    return Claims.of_detector(
        np.array([one.box_px for one in found], np.float32).reshape(-1, 4),
        np.array([vocabulary.index(one.label) for one in found], np.int64),
        np.array([one.score for one in found], np.float32),
    )


def label_request_message(region: Region, stamp_ns: int) -> LabelRequest:
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


def crops_of(request: LabelRequest) -> list[np.ndarray]:
    """Each [h, w, 3] uint8 RGB. Raises FrameError for bytes that are no such image."""
    return [codecs.decode_color(c.encoding, c.width, c.height, c.data) for c in request.crops]


def correction_message(
    stamp_ns: int,
    graph_version: int,
    T_map_keyframe: dict[int, np.ndarray],
    refinements: int = 0,
    joined: Mapping[int, int] | None = None,
    *,
    closures: Iterable[tuple[int, int]] = (),
    not_believed: Iterable[tuple[int, int]] = (),
    landmarks: Iterable[GraphLandmark] = (),
) -> Correction:
    T = np.array(list(T_map_keyframe.values())).reshape(-1, 4, 4)
    rows = np.concatenate([T[:, :3, 3], quaternions(T[:, :3, :3])], axis=1)
    return Correction(
        stamp_ns=stamp_ns,
        graph_version=graph_version,
        keyframes=Array.of(np.array(list(T_map_keyframe), np.int64)),
        T_map_keyframe=Array.of(rows),
        refinements=refinements,
        joined=tuple(sorted((joined or {}).items())),
        closures=tuple(closures),
        not_believed=tuple(not_believed),
        landmarks=tuple(landmarks),
    )


def landmark_message(
    landmark: int, centroid: np.ndarray, p: np.ndarray, names: Sequence[str]
) -> GraphLandmark:
    """`names` of the classes that have been seen; what `p` [C] gives to others is on none."""
    return GraphLandmark(
        object=landmark,
        centroid=_vector3(centroid),
        distribution=_distribution_message(p[: len(names)], names),
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


def keyframe_poses_of(
    correction: Correction, only: Iterable[int] | None = None
) -> dict[int, np.ndarray]:
    """T_map_keyframe [4, 4] by keyframe id; of `only` those and the newest one it names."""
    keyframes = correction.keyframes.numpy()
    rows = correction.T_map_keyframe.numpy()
    if only is not None and len(keyframes):
        chosen = np.isin(keyframes, list(only))
        chosen[-1] = True
        keyframes, rows = keyframes[chosen], rows[chosen]
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = se3.rotation(rows[:, 3:]), rows[:, :3]
    return dict(zip(keyframes.tolist(), T, strict=True))


def camera_rgbd_message(raw: RawFrame, compress_depth: bool = True) -> CameraRgbd:
    """A camera's frame for the wire: colour raw, depth raw or compressed with zstd."""
    height, width = raw.depth.shape
    depth = np.asarray(raw.depth, np.float32) if raw.depth.dtype == np.float64 else raw.depth
    encoding: ImageEncoding = "z16" if depth.dtype == np.uint16 else "f32"
    data = depth.tobytes()
    if compress_depth:
        encoding, data = codecs.encode_depth(depth)
    return CameraRgbd(
        stamp_ns=raw.stamp_ns,
        frame=raw.index,
        camera=camera_message(raw.camera),
        color=Image(
            encoding="rgb8", width=width, height=height, data=memoryview(raw.color.tobytes())
        ),
        depth=Image(encoding=encoding, width=width, height=height, data=memoryview(data)),
        depth_scale=raw.depth_scale,
    )


def raw_frame_of(message: CameraRgbd, index: int) -> RawFrame:
    """The frame as the camera delivered it, decompressed. Raises DataError."""
    color, depth = message.color, message.depth
    return RawFrame(
        index=index,
        stamp_ns=message.stamp_ns,
        color=codecs.decode_color(color.encoding, color.width, color.height, color.data),
        depth=codecs.decode_depth(depth.encoding, depth.width, depth.height, depth.data),
        depth_scale=message.depth_scale,
        camera=camera_of(message.camera),
    )


def map_objects(table: np.ndarray, names: Sequence[str]) -> tuple[MapObject, ...]:
    """Of landmarks [K], in their order."""
    p = distributions(table)
    columns = zip(table, labels_of(table).tolist(), p, entropy(p).tolist(), strict=True)
    return tuple(_object_message(*column, names) for column in columns)


def _object_message(
    landmark: np.void, label: int, p: np.ndarray, entropy: float, names: Sequence[str]
) -> MapObject:
    T, views = landmark["T_map_object"], landmark["view_keyframes"]
    return MapObject(
        id=int(landmark["id"]),
        name=names[label],
        confidence=min(float(p[label]), 1.0),
        centroid=_vector3(landmark["centroid"]),
        covariance=tuple(landmark["covariance"].ravel().tolist()),
        T_map_object=pose_message(T),
        size=_vector3(landmark["size"]),
        distribution=_distribution_message(p, names),
        entropy=max(entropy, 0.0),
        seen=int(landmark["seen"]),
        missed=int(landmark["missed"]),
        first_keyframe=int(landmark["first"]),
        last_keyframe=int(landmark["last"]),
        views=tuple(
            ObjectView(keyframe=int(views[i]), box_px=_box(landmark["view_boxes"][i]))
            for i in np.flatnonzero(views >= 0)
        ),
    )


def observation_messages(
    observed: Observed, names: Sequence[str], keyframe: int, stamp_ns: int
) -> list[ObjectObservation]:
    """What a keyframe shows of objects, and what it misses."""
    return [
        ObjectObservation(
            stamp_ns=stamp_ns,
            keyframe=keyframe,
            object=seen.object,
            box_px=_box(seen.box),
            distribution=_distribution_message(seen.distribution, names),
            entropy=max(float(seen.entropy), 0.0),
            is_miss=seen.is_miss,
        )
        for seen in observed.observations
    ]


def _distribution_message(p: np.ndarray, names: Sequence[str]) -> Distribution:
    labels, weights = sparse(p)
    pairs = zip(labels, weights, strict=True)
    return tuple((names[int(label)], float(weight)) for label, weight in pairs if weight > 0)


def _vector3(v: np.ndarray) -> tuple[float, float, float]:
    x, y, z = v.tolist()
    return x, y, z


def _box(box: np.ndarray) -> Box:
    x0, y0, x1, y1 = box.tolist()
    return x0, y0, x1, y1


def boxes_in(detections: Sequence[Detection], times: float) -> list[MovableBox]:
    """Detections as edges of pixels, in an image that is so many times smaller."""
    return [
        MovableBox(one.label, *((edge + 0.5) / times for edge in one.box_px)) for one in detections
    ]


def loop_closure_message(finding: Finding) -> LoopClosure:
    """Raises ValueError for a candidate that was refused."""
    if finding.closure is None:
        raise ValueError(f"a candidate that was refused is no closure: {finding.check.refused}")
    return LoopClosure(
        stamp_ns=finding.check.proposal.new.stamp_ns,
        pose=measured_message(finding.closure),
        overlap=finding.check.overlap,
        rmse_m=finding.check.rmse_m,
        entropy=finding.check.proposal.semantics.entropy,
    )


def loop_candidate_message(finding: Finding) -> LoopCandidate:
    check, old, new = finding.check, finding.likeness.subgraph, finding.new
    proposal = check.proposal
    return LoopCandidate(
        stamp_ns=new.stamp_ns,
        keyframe=new.keyframes[-1],
        reference=old.keyframes[-1],
        keyframes=new.keyframes,
        references=old.keyframes,
        similarity=finding.likeness.similarity,
        appearance=finding.likeness.appearance,
        evidence=proposal.evidence,
        inliers=proposal.inliers,
        divergence=proposal.semantics.divergence,
        entropy=proposal.semantics.entropy,
        overlap=check.overlap,
        rmse_m=check.rmse_m,
        refused=check.refused,
    )
