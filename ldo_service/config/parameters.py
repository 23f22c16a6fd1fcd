"""Conversion of the configuration to the parameters of the actors and of the runtime.

This module and `network_parameters` define which parameters each setting determines. Some
settings determine parameters of several actors. A parameter without a setting keeps the default of
its class. A comment in that class gives the reason for the default.
"""

from ldo_service.actors.frame_source import FrameSourceConfig
from ldo_service.actors.loop_closer import LoopCloserConfig
from ldo_service.actors.mapper_config import MapperConfig
from ldo_service.actors.optimizer import OptimizerConfig
from ldo_service.actors.topology import ActorParameters
from ldo_service.actors.tracker import CameraExtrinsics, TrackerConfig
from ldo_service.calibration.self_calibration import SelfCalibrationConfig
from ldo_service.detection.dynamic_classes import DynamicClassConfig
from ldo_service.gaussians.adam import AdamConfig
from ldo_service.gaussians.densification import DensificationConfig
from ldo_service.gaussians.keyframe_store import KeyframeStoreConfig
from ldo_service.gaussians.loop_refit import LoopRefitConfig
from ldo_service.gaussians.loss import LossWeights
from ldo_service.gaussians.map_builder_config import MapBuilderConfig
from ldo_service.gaussians.optimizer import GaussianOptimizerConfig
from ldo_service.gaussians.pruning import PruningConfig
from ldo_service.gaussians.visibility import OffloadConfig
from ldo_service.loop_closing import LoopsConfig
from ldo_service.loop_closing.consistency_check import ConsistencyCheckConfig
from ldo_service.loop_closing.loop_detector import LOOP_MIN_INLIERS
from ldo_service.loop_closing.object_points import LandmarkConfig
from ldo_service.loop_closing.place_database import RetrievalConfig
from ldo_service.loop_closing.pose_estimation import DepthConsistencyConfig
from ldo_service.loop_closing.subgraph import SubgraphConfig
from ldo_service.loop_closing.verification import VerificationConfig
from ldo_service.maps.publisher import PublishConfig
from ldo_service.pose_graph.factors import NoiseConfig
from ldo_service.pose_graph.landmarks import ObjectLandmarkConfig
from ldo_service.pose_graph.loop_closures import LoopClosureConfig
from ldo_service.pose_graph.pose_graph_config import PoseGraphConfig
from ldo_service.recordings.mcap_file import RecordConfig
from ldo_service.regions.foreground import ForegroundConfig
from ldo_service.regions.open_vocabulary import OpenVocabularyConfig
from ldo_service.regions.region_proposals import RegionProposalConfig
from ldo_service.regions.region_tracker_config import RegionTrackerConfig
from ldo_service.runtime.supervision_policy import SupervisionConfig
from ldo_service.semantics.data_association import AssociationConfig
from ldo_service.semantics.gaussian_labels import ConsistencyConfig, LabelConfig
from ldo_service.semantics.label_assignment import AssignmentConfig
from ldo_service.semantics.objects_config import ObjectsConfig
from ldo_service.semantics.semantic_fusion import FusionConfig, SemanticFusionConfig
from ldo_service.semantics.semantic_map import SemanticMapConfig
from ldo_service.tracking.alignment import AlignConfig, ResidualConfig
from ldo_service.tracking.features import FeatureConfig
from ldo_service.tracking.keyframe_database import KeyframeDatabaseConfig
from ldo_service.tracking.keyframe_reuse import KeyframeReuseConfig
from ldo_service.tracking.keyframes import KeyframeConfig
from ldo_service.tracking.motion_segmentation import MotionSegmentationConfig
from ldo_service.tracking.odometry_config import OdometryConfig
from ldo_service.tracking.odometry_prior import PriorConfig
from ldo_service.tracking.pyramid import DepthNoise, PyramidConfig
from ldo_service.tracking.relocalization import RelocalizationConfig
from ldo_service.tracking.shutter import ShutterConfig
from ldo_service.tracking.submaps import SubmapConfig
from ldo_service.tracking.tracking_quality import TrackingQualityConfig
from ldo_service.tracking.window import WindowConfig

from .network_parameters import detector_parameters, labeller_parameters
from .sections import Config

FOREGROUND = ForegroundConfig()  # Foreground test of labels, regions and loop-closure landmarks.


def actor_parameters(config: Config) -> ActorParameters:
    """Return the parameters of all actors."""
    return ActorParameters(
        frame_source=FrameSourceConfig(max_skew_s=config.frame_source.max_skew_s),
        tracker=_tracker(config),
        detector=detector_parameters(config),
        vlm_labeller=labeller_parameters(config),
        mapper=_mapper(config),
        loop_closer=_loop_closer(config),
        optimizer=_optimizer(config),
    )


def stage_parameters(config: Config) -> SupervisionConfig:
    """Return the parameters for the supervision of actors."""
    supervision = config.supervision
    return SupervisionConfig(
        max_restarts=supervision.max_restarts,
        heartbeat_s=supervision.heartbeat_s,
        stall_after_s=supervision.step_timeout_s,
        backend_stall_after_s=supervision.backend_step_timeout_s,
        backlog_mb=supervision.backlog_mb,
        evict_after_s=supervision.evict_after_s,
        nice=supervision.background_nice,
        max_message_mb=config.service.max_decoded_message_mb,
    )


def recording_parameters(config: Config) -> RecordConfig:
    """Return the limits of a recording."""
    recording = config.recording
    return RecordConfig(max_gb=recording.max_gb, min_free_gb=recording.min_free_gb)


def latency_frames(config: Config) -> dict[str, int]:
    """Return the latency of actors on the logical clock, in frames, by the actor's name."""
    latency = config.offline.latency_frames
    return {
        "detector": latency.detector,
        "loop_closer": latency.loop_closer,
        "mapper": latency.mapper,
        "optimizer": latency.optimizer,
        "vlm_labeller": latency.vlm_labeller,
    }


# --- shared by several actors ---------------------------------------------------------------------
def _dynamic_classes(config: Config) -> DynamicClassConfig:
    return DynamicClassConfig(classes=config.detector.dynamic_classes)


def _pyramid(config: Config) -> PyramidConfig:
    image = config.tracker.image
    return PyramidConfig(
        working_width_px=image.width_px, levels=image.pyramid_levels, max_depth_m=image.max_depth_m
    )


def _align(config: Config) -> AlignConfig:
    noise = config.tracker.depth_noise
    return AlignConfig(
        residuals=ResidualConfig(
            noise=DepthNoise(floor_m=noise.floor_m, growth_per_m=noise.growth_per_m)
        ),
        iterations=config.tracker.alignment.max_iterations,
    )


def _keyframe_database(config: Config) -> KeyframeDatabaseConfig:
    return KeyframeDatabaseConfig(count=config.tracker.relocalization.max_keyframes)


# --- the tracker ----------------------------------------------------------------------------------
def _tracker(config: Config) -> TrackerConfig:
    tracker = config.tracker
    mounting = tracker.T_base_camera
    return TrackerConfig(
        T_base_camera=CameraExtrinsics(mounting.translation_m, mounting.quaternion_wxyz),
        odometry=OdometryConfig(
            device=config.service.device,
            pyramid=_pyramid(config),
            align=_align(config),
            features=FeatureConfig(count=tracker.features.max_features),
            keyframes=_keyframes(config),
            window=WindowConfig(measurements=tracker.window.max_measurements),
            keyframe_database=_keyframe_database(config),
            relocalization=RelocalizationConfig(
                appearance_candidates=tracker.relocalization.appearance_candidates,
                across_scales=tracker.relocalization.sift_candidates,
            ),
            keyframe_reuse=KeyframeReuseConfig(after=tracker.keyframes.reuse_after),
            submaps=SubmapConfig(begin_after_frames=tracker.submaps.start_after_lost_frames),
            tracking_quality=TrackingQualityConfig(
                min_overlap=tracker.quality.weak_overlap,
                weak_residual=tracker.quality.weak_residual_ratio,
                lost_residual=tracker.quality.lost_residual_ratio,
                lost_overlap=tracker.quality.lost_overlap,
            ),
            moving=MotionSegmentationConfig(is_on=tracker.dynamics.enabled),
            movable=_dynamic_classes(config),
            prior=PriorConfig(
                max_gap_s=tracker.odometry_prior.max_gap_s,
                max_dead_reckoning_s=tracker.odometry_prior.max_dead_reckoning_s,
            ),
            shutter=ShutterConfig(is_on=tracker.self_calibration),
        ),
        calibration=SelfCalibrationConfig()
        if tracker.self_calibration
        else SelfCalibrationConfig(views=()),
        localize=tracker.localization_map,
        calibration_run=tracker.calibration_run,
        hold_out=tracker.hold_out,
    )


def _keyframes(config: Config) -> KeyframeConfig:
    keyframes = config.tracker.keyframes
    return KeyframeConfig(
        min_overlap=keyframes.min_overlap,
        max_rotation_rad=keyframes.max_rotation_rad,
        max_translation=keyframes.max_translation_ratio,
        min_frames=keyframes.min_interval_frames,
        max_frames=keyframes.max_interval_frames,
        mapping_only_ratio=keyframes.mapping_only_ratio,
    )


# --- the mapper -----------------------------------------------------------------------------------
def _mapper(config: Config) -> MapperConfig:
    mapper = config.mapper
    return MapperConfig(
        builder=_map_builder(config),
        semantics=_semantics(config),
        iterations=mapper.iterations,
        folder=mapper.image_folder,
        threads=mapper.threads,
        publish=PublishConfig(
            max_gaussians_per_message=mapper.publish.max_gaussians_per_message,
            update_interval_keyframes=mapper.publish.update_interval_keyframes,
            snapshot_interval_keyframes=mapper.publish.snapshot_interval_keyframes,
        ),
        checkpoint_keyframes=mapper.checkpoint_interval_keyframes,
        refit=LoopRefitConfig(
            iterations=mapper.refit.iterations,
            iterations_per_keyframe=mapper.refit.iterations_per_keyframe,
        ),
    )


def _map_builder(config: Config) -> MapBuilderConfig:
    mapper, rates, loss = config.mapper, config.mapper.learning_rate, config.mapper.loss
    return MapBuilderConfig(
        insertion=DensificationConfig(
            max_transmittance=mapper.densify.max_transmittance,
            coarsest_px=mapper.densify.max_cell_px,
        ),
        optimizer=GaussianOptimizerConfig(
            device=config.service.device,
            adam=AdamConfig(
                mean_m=rates.mean_m,
                log_scale=rates.log_scale,
                quat=rates.quaternion,
                opacity_logit=rates.opacity_logit,
                color=rates.color,
            ),
            loss=LossWeights(l1=loss.l1, d_ssim=loss.d_ssim, depth=loss.depth),
            max_sigma_px=loss.max_sigma_px,
            rotation_rate_rad=rates.pose_rotation_rad,
            translation_rate_m=rates.pose_translation_m,
        ),
        pruning=PruningConfig(min_opacity=mapper.prune.min_opacity),
        store=KeyframeStoreConfig(
            cache_mb=mapper.keyframe_images.memory_mb,
            quota_mb=mapper.keyframe_images.disk_mb,
            max_keyframes=mapper.keyframe_images.max_keyframes,
        ),
        offload=OffloadConfig(max_active=mapper.offload.max_resident_gaussians),
        prune_keyframes=mapper.prune.interval_keyframes,
        seed=mapper.seed,
    )


def _semantics(config: Config) -> SemanticMapConfig:
    objects, paper = config.mapper.objects, config.paper
    return SemanticMapConfig(
        labelling=_labelling(config),
        objects=ObjectsConfig(
            association=AssociationConfig(
                min_iou=objects.min_iou, max_depth_gap_m=paper.max_depth_gap_m
            ),
            min_keyframes=objects.min_observations,
            max_divergence=paper.object_max_divergence_nats,
            miss_limit=objects.max_misses,
            max_objects=objects.max_objects,
        ),
        naming=_naming(config),
        movable=_dynamic_classes(config),
        max_names=config.mapper.semantics.max_label_names,
    )


def _labelling(config: Config) -> SemanticFusionConfig:
    paper = config.paper
    return SemanticFusionConfig(
        region=paper.label_region,
        foreground=FOREGROUND,
        assignment=AssignmentConfig(
            rule=paper.assignment_rule,
            min_overlap=config.mapper.semantics.min_overlap,
            max_depth_gap_m=paper.max_depth_gap_m,
            depth_test=paper.depth_test,
        ),
        fusion=FusionConfig(
            rule=paper.fusion_rule,
            beta=paper.fusion_beta,
            epsilon=paper.fusion_epsilon,
            fixed_alpha=paper.fusion_fixed_weight,
        ),
        labels=LabelConfig(
            ema=paper.ema_rule,
            keep=paper.ema_keep_ratio,
            miss_limit=paper.label_max_misses,
            hold_back=paper.ema_hold_back_ratio,
        ),
        consistency=ConsistencyConfig(
            sigma_m=paper.consistency_sigma_m,
            radius_m=paper.consistency_radius_m,
            rate=paper.consistency_rate,
        ),
    )


def _naming(config: Config) -> OpenVocabularyConfig:
    naming = config.mapper.open_vocabulary
    return OpenVocabularyConfig(
        trigger=RegionProposalConfig(sure=naming.confident_score, foreground=FOREGROUND),
        regions=RegionTrackerConfig(
            per_keyframe=naming.requests_per_keyframe, boxes_vote=naming.detector_votes
        ),
        min_sure=naming.min_confidence,
    )


# --- loops and the graph --------------------------------------------------------------------------
def _loop_closer(config: Config) -> LoopCloserConfig:
    closer, paper = config.loop_closer, config.paper
    return LoopCloserConfig(
        is_on=closer.enabled,
        loops=LoopsConfig(
            stages=closer.retrieval.mode,
            subgraphs=SubgraphConfig(
                min_keyframes=paper.subgraph_min_keyframes,
                max_keyframes=paper.subgraph_max_keyframes,
            ),
            retrieval=RetrievalConfig(
                exclude_frames=closer.retrieval.min_gap_frames,
                candidates=closer.retrieval.max_candidates,
                min_similarity=closer.retrieval.min_similarity,
                count=closer.retrieval.max_subgraphs,
            ),
            verification=VerificationConfig(
                landmarks=LandmarkConfig(
                    foreground=FOREGROUND, max_divergence=paper.loop_max_divergence_nats
                ),
                fit=DepthConsistencyConfig(
                    min_overlap=closer.verification.min_overlap,
                    max_rmse_m=closer.verification.max_rmse_m,
                ),
                min_inliers=closer.verification.min_inliers,
            ),
            plausibility=ConsistencyCheckConfig(
                drift_m=closer.drift_gate.max_drift_m, drift=closer.drift_gate.max_drift_ratio
            ),
            keyframe_database=_keyframe_database(config),
            pyramid=_pyramid(config),
            features=FeatureConfig(
                count=config.tracker.features.max_features, min_inliers=LOOP_MIN_INLIERS
            ),
            align=_align(config),
        ),
        movable=_dynamic_classes(config),
    )


def _optimizer(config: Config) -> OptimizerConfig:
    optimizer, paper = config.optimizer, config.paper
    return OptimizerConfig(
        graph=PoseGraphConfig(
            noise=NoiseConfig(
                drift_rad_per_sqrt_m=optimizer.noise.drift_rad_per_sqrt_m,
                drift_m_per_sqrt_m=optimizer.noise.drift_m_per_sqrt_m,
                sigma_loop_rad=optimizer.noise.loop_rotation_rad,
                sigma_loop_m=optimizer.noise.loop_translation_m,
                independent_observations=paper.observation_information_ratio,
            ),
            closures=LoopClosureConfig(
                max_sigmas=optimizer.loop_closures.max_residual_sigmas,
                max_closures=optimizer.loop_closures.max_closures,
            ),
            condense_keyframes=paper.marginalization_interval_keyframes,
        ),
        landmarks=ObjectLandmarkConfig(
            lambda_sem=paper.lambda_sem,
            w_sem=paper.w_sem,
            max_landmarks=optimizer.landmarks.max_landmarks,
            schedule=optimizer.landmarks.schedule,
        ),
        uses_objects=optimizer.landmarks.enabled,
    )
