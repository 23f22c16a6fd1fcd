"""Small example messages of every type, with every field set.

The golden file of a new type is written by

    python tests/schemas/examples.py

It writes the missing files and never changes an existing one. A golden file is a message that an
earlier version sent, and every later version must still read it.
"""

from pathlib import Path

import msgspec
import numpy as np

from ldo_service.schemas import (
    AddLabel,
    AnchorMotion,
    Array,
    CameraColor,
    CameraDepth,
    CameraModel,
    CameraRgbd,
    ControlAnswer,
    ControlRequest,
    Detection,
    DetectionBoxes,
    FrameRgbd,
    Gaussians,
    GraphCorrection,
    GraphLandmark,
    Health,
    Image,
    InputCount,
    Keyframe,
    KeyframeMeasurements,
    KeyframeRefinement,
    LabelNames,
    LabelRequest,
    LabelResult,
    LoopCandidate,
    LoopClosure,
    MapDelta,
    MapObject,
    MapObjects,
    MapRendering,
    MapSnapshot,
    MeasuredPose,
    Message,
    ObjectObservation,
    ObjectView,
    OdometryPrior,
    OutputCount,
    Pose,
    RefineMap,
    TrackedPose,
    encode,
)

GOLDEN = Path(__file__).parent / "golden"

CAMERA = CameraModel(width=3, height=2, fx=2.5, fy=2.25, cx=1.0, cy=0.5)
COLOR = Array.of(np.arange(18, dtype=np.uint8).reshape(2, 3, 3))
DEPTH = Array.of(np.array([[0.0, 1.5, 2.0], [0.25, 4.0, 0.0]], np.float32))
POSE = Pose((1.0, -2.0, 0.5), (0.5, -0.5, 0.5, 0.5))
OTHER_POSE = Pose((0.0, 0.125, 0.0), (0.6, 0.0, 0.8, 0.0))
INFORMATION = tuple(float(10 * (i // 6) + i % 6) for i in range(36))


def gaussians(ids: list[int]) -> Gaussians:
    params = np.arange(16 * len(ids), dtype=np.float32).reshape(-1, 16)
    return Gaussians(
        ids=Array.of(np.array(ids, np.int64)),
        params=Array.of(params),
        anchors=Array.of(np.arange(len(ids), dtype=np.int32)),
    )


def labelled_gaussians(ids: list[int]) -> Gaussians:
    """Return Gaussians that are chair with probability 0.75, observed at 0.5 m."""
    row = np.zeros(32, np.uint8)
    row[:24] = np.array([0.75, 0, 0, 0, 0, 1.5], "<f4").view(np.uint8)
    row[24:26], row[27] = np.array([500], "<u2").view(np.uint8), 58
    return msgspec.structs.replace(gaussians(ids), labels=Array.of(np.tile(row, (len(ids), 1))))


LABEL_NAMES = ("background", "other", "person")


EXAMPLES: dict[str, Message] = {
    "label_request": LabelRequest(
        stamp_ns=1_700_000_000_000_000_031,
        region=12,
        keyframe=40,
        box_px=(-0.5, 3.25, 17.5, 20.0),
        crops=(
            Image(encoding="rgb8", width=2, height=1, data=memoryview(b"\1\2\3\4\5\6")),
            Image(encoding="jpeg", width=9, height=7, data=memoryview(b"\xff\xd8\xff")),
        ),
        label="vase",
        score=0.375,
    ),
    "label_result": LabelResult(
        stamp_ns=1_700_000_000_000_000_032,
        region=12,
        keyframe=40,
        label="samovar",
        confidence=0.8125,
        labeller="clip 0123456789ab",
    ),
    "label_result_with_alternatives": LabelResult(
        stamp_ns=1_700_000_000_000_000_032,
        region=12,
        keyframe=40,
        label="samovar",
        confidence=0.5,
        labeller="clip 0123456789ab",
        alternatives=(("teapot", 0.25), ("vase", 0.125)),
    ),
    "add_label": AddLabel(stamp_ns=1_700_000_000_000_000_033, name="samovar"),
    "label_names": LabelNames(
        stamp_ns=1_700_000_000_000_000_033, names=("cup", "samovar"), error="why not"
    ),
    "camera_rgbd": CameraRgbd(
        stamp_ns=1_700_000_000_000_000_001,
        frame=7,
        camera=CameraModel(
            width=2, height=1, fx=2.5, fy=2.25, cx=1.0, cy=0.5, distortion=(0.1, -0.2, 0.01, 0.02)
        ),
        color=Image(encoding="bgr8", width=2, height=1, data=memoryview(b"\1\2\3\4\5\6")),
        depth=Image(encoding="z16", width=2, height=1, data=memoryview(b"\x88\x13\0\0")),
        depth_scale=5000.0,
    ),
    "camera_color": CameraColor(
        stamp_ns=1_700_000_000_000_000_002,
        frame=8,
        camera=CAMERA,
        image=Image(encoding="jpeg", width=3, height=2, data=memoryview(b"\xff\xd8\xff\xd9")),
    ),
    "camera_depth": CameraDepth(
        stamp_ns=1_700_000_000_000_000_003,
        frame=9,
        camera=CameraModel(width=2, height=1, fx=1.5, fy=1.25, cx=0.5, cy=0.25),
        image=Image(encoding="z16+zstd", width=2, height=1, data=memoryview(b"\x28\xb5\x2f\xfd")),
        depth_scale=1000.0,
        T_color_depth=POSE,
    ),
    "odometry_prior": OdometryPrior(stamp_ns=1_700_000_000_000_000_004, T_prior_base=POSE),
    "frame_rgbd": FrameRgbd(stamp_ns=2, frame=8, camera=CAMERA, color=COLOR, depth_m=DEPTH),
    "keyframe": Keyframe(
        stamp_ns=3,
        keyframe=4,
        frame=9,
        camera=CAMERA,
        color=COLOR,
        depth_m=DEPTH,
        reference=3,
        T_reference_keyframe=POSE,
        information=INFORMATION,
        T_odom_keyframe=OTHER_POSE,
        overlap=0.75,
    ),
    "keyframe_measurements": KeyframeMeasurements(
        stamp_ns=3,
        keyframe=4,
        camera=CAMERA,
        reference=3,
        T_reference_keyframe=POSE,
        information=INFORMATION,
        T_odom_keyframe=OTHER_POSE,
        window_measurements=(
            MeasuredPose(
                reference=1, keyframe=4, T_reference_keyframe=OTHER_POSE, information=INFORMATION
            ),
        ),
    ),
    "keyframe_with_a_window": Keyframe(
        stamp_ns=3,
        keyframe=4,
        frame=9,
        camera=CAMERA,
        color=COLOR,
        depth_m=DEPTH,
        reference=3,
        T_reference_keyframe=POSE,
        information=INFORMATION,
        T_odom_keyframe=OTHER_POSE,
        window_measurements=(
            MeasuredPose(
                reference=1, keyframe=4, T_reference_keyframe=OTHER_POSE, information=INFORMATION
            ),
        ),
    ),
    "keyframe_with_what_moves": Keyframe(
        stamp_ns=3,
        keyframe=4,
        frame=9,
        camera=CAMERA,
        color=COLOR,
        depth_m=DEPTH,
        reference=3,
        T_reference_keyframe=POSE,
        information=INFORMATION,
        T_odom_keyframe=OTHER_POSE,
        overlap=0.75,
        dynamic_mask=Array.of((DEPTH.numpy() > 0).astype(np.uint8)),
    ),
    "keyframe_that_joins": Keyframe(
        stamp_ns=3,
        keyframe=5,
        frame=10,
        camera=CAMERA,
        color=COLOR,
        depth_m=DEPTH,
        reference=4,
        T_reference_keyframe=POSE,
        information=INFORMATION,
        T_odom_keyframe=OTHER_POSE,
        overlap=0.5,
        submap=1,
        submap_measurements=(
            MeasuredPose(
                reference=2, keyframe=5, T_reference_keyframe=POSE, information=INFORMATION
            ),
        ),
    ),
    "graph_correction_that_joins": GraphCorrection(
        stamp_ns=9,
        graph_version=4,
        keyframes=Array.of(np.array([0, 4], np.int64)),
        T_map_keyframe=Array.of(
            np.array([[0, 0, 0, 1, 0, 0, 0], [1, 2, 3, 0.6, 0, 0.8, 0]], float)
        ),
        last_refinement=1,
        merged_submaps=((1, 0), (2, 0)),
    ),
    "graph_correction_with_landmarks": GraphCorrection(
        stamp_ns=9,
        graph_version=5,
        keyframes=Array.of(np.array([4], np.int64)),
        T_map_keyframe=Array.of(np.array([[1, 2, 3, 0.6, 0, 0.8, 0]], float)),
        accepted_closures=((0, 4), (1, 9)),
        rejected_closures=((2, 7),),
        landmarks=(
            GraphLandmark(
                object=3,
                centroid=(1.0, -2.0, 0.5),
                distribution=(("chair", 0.75), ("other", 0.25)),
                entropy=0.5623351446188083,
            ),
        ),
    ),
    "tracked_pose": TrackedPose(
        stamp_ns=4,
        frame=10,
        status="WEAK",
        T_odom_camera=POSE,
        T_map_odom=OTHER_POSE,
        graph_version=2,
        reference=3,
        T_reference_camera=POSE,
        keyframe=4,
        covariance=INFORMATION,
        inlier_fraction=0.5,
        residual_color=3.25,
        residual_depth=1.125,
        overlap=0.625,
        iterations=12,
    ),
    "tracked_pose_of_a_robot": TrackedPose(
        stamp_ns=4,
        frame=10,
        status="OK",
        T_odom_camera=POSE,
        T_map_odom=OTHER_POSE,
        graph_version=2,
        reference=None,
        T_reference_camera=POSE,
        T_base_camera=OTHER_POSE,
    ),
    "control_request": ControlRequest(stamp_ns=11, command="reset"),
    "control_answer": ControlAnswer(stamp_ns=11, ok=False, message="mapper did not answer"),
    "graph_correction": GraphCorrection(
        stamp_ns=5,
        graph_version=3,
        keyframes=Array.of(np.array([0, 4], np.int64)),
        T_map_keyframe=Array.of(
            np.array([[0, 0, 0, 1, 0, 0, 0], [1, -2, 0.5, 0.5, -0.5, 0.5, 0.5]], np.float64)
        ),
    ),
    "map_rendering": MapRendering(
        stamp_ns=6,
        keyframe=4,
        version=5,
        graph_version=3,
        camera=CAMERA,
        T_map_camera=POSE,
        color=COLOR,
        depth_m=DEPTH,
        opacity=Array.of(np.array([[0, 255, 128], [1, 2, 3]], np.uint8)),
    ),
    "map_delta": MapDelta(
        stamp_ns=7,
        base_version=4,
        version=5,
        graph_version=3,
        motions=(AnchorMotion(keyframe=1, T_new_old=POSE),),
        removed=Array.of(np.array([2, 3], np.int64)),
        changed=gaussians([1]),
        added=gaussians([8, 9]),
    ),
    "map_delta_with_labels": MapDelta(
        stamp_ns=7,
        base_version=4,
        version=5,
        graph_version=3,
        motions=(),
        removed=Array.of(np.zeros(0, np.int64)),
        changed=labelled_gaussians([1, 5]),
        added=gaussians([8]),
        label_names=LABEL_NAMES,
    ),
    "map_snapshot_with_labels": MapSnapshot(
        stamp_ns=8,
        version=5,
        graph_version=3,
        part=0,
        parts=2,
        gaussians=labelled_gaussians([1, 8]),
        label_names=LABEL_NAMES,
    ),
    "map_snapshot": MapSnapshot(
        stamp_ns=8, version=5, graph_version=3, part=1, parts=2, gaussians=gaussians([1, 8])
    ),
    "map_snapshot_with_exposures": MapSnapshot(
        stamp_ns=8,
        version=5,
        graph_version=3,
        part=0,
        parts=2,
        gaussians=gaussians([1, 8]),
        keyframes=Array.of(np.array([0, 3], np.int64)),
        exposures=Array.of(np.arange(12, dtype=np.float32).reshape(2, 2, 3)),
    ),
    "refine_map": RefineMap(stamp_ns=12, iterations=50, initial_rate=1.0, final_rate=0.5),
    "keyframe_refinement": KeyframeRefinement(
        stamp_ns=13,
        poses=(
            MeasuredPose(
                reference=3, keyframe=4, T_reference_keyframe=POSE, information=INFORMATION
            ),
        ),
    ),
    "detection_boxes": DetectionBoxes(
        stamp_ns=3,
        keyframe=4,
        width=3,
        height=2,
        detections=(
            Detection(label="potted plant", score=0.75, box_px=(-0.5, 0.25, 1.5, 1.5)),
            Detection(label="cup", score=0.5, box_px=(0.5, -0.5, 2.5, 1.0)),
        ),
        network="tiny 0123456789ab",
    ),
    "object_observation": ObjectObservation(
        stamp_ns=3,
        keyframe=4,
        object=2,
        box_px=(-0.5, 0.25, 1.5, 1.5),
        distribution=(("potted plant", 0.75), ("background", 0.125)),
        entropy=0.625,
        is_miss=True,
    ),
    "loop_closure": LoopClosure(
        stamp_ns=8,
        pose=MeasuredPose(
            reference=1, keyframe=9, T_reference_keyframe=POSE, information=INFORMATION
        ),
        overlap=0.625,
        rmse_m=0.03125,
        entropy=0.25,
    ),
    "loop_candidate": LoopCandidate(
        stamp_ns=8,
        keyframe=9,
        reference=2,
        keyframes=(7, 8, 9),
        reference_keyframes=(1, 2),
        similarity=0.875,
        appearance=0.5,
        evidence="landmarks",
        inliers=4,
        divergence=0.125,
        entropy=0.25,
        overlap=0.125,
        rmse_m=0.0625,
        rejected_reason="overlap 0.12 is under 0.2",
    ),
    "map_objects": MapObjects(
        stamp_ns=8,
        version=5,
        graph_version=3,
        objects=(
            MapObject(
                id=2,
                name="potted plant",
                confidence=0.75,
                centroid=(1.0, -2.0, 0.5),
                covariance=(0.25, 0.0, 0.125, 0.0, 0.5, 0.0, 0.125, 0.0, 1.0),
                T_map_object=POSE,
                size=(0.5, 1.0, 2.0),
                distribution=(("potted plant", 0.75), ("vase", 0.25)),
                entropy=0.5,
                observation_count=7,
                miss_count=1,
                first_keyframe=1,
                last_keyframe=9,
                views=(ObjectView(keyframe=4, box_px=(0.0, 0.25, 1.5, 1.5)),),
            ),
        ),
    ),
    "health": Health(
        stamp_ns=9,
        actor="mapper",
        state="busy",
        pid=4242,
        epoch=17,
        steps=100,
        failures=2,
        restarts=2,
        dead_lettered=1,
        step_age_s=0.25,
        current_step_s=0.125,
        step_ms_p50=20.0,
        step_ms_p95=31.5,
        rss_mb=512.5,
        inputs=(
            InputCount(
                topic="keyframe/new",
                delivered=90,
                dropped=0,
                rejected=1,
                gaps=2,
                queued=3,
                peak_queued=8,
            ),
        ),
        outputs=(
            OutputCount(
                topic="map/view",
                sent=90,
                backpressure_waits=4,
                evicted_consumers=1,
                retransmitted=3,
            ),
        ),
        metrics={"gaussians": 1000.0},
    ),
}


def write_missing() -> None:
    """Write the golden files that do not exist yet."""
    for name, message in EXAMPLES.items():
        path = GOLDEN / f"{name}.msgpack"
        if not path.exists():
            path.write_bytes(encode(message))
            print(f"wrote {path}")


if __name__ == "__main__":
    write_missing()
