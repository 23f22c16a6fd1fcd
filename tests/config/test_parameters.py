"""Parameters of actors: their defaults, and values that several actors share."""

from ldo_service.actors.topology import ActorParameters
from ldo_service.config import (
    Config,
    actor_parameters,
    latency_frames,
    load_config,
    recording_parameters,
    stage_parameters,
)
from ldo_service.recordings.mcap_file import RecordConfig
from ldo_service.runtime.supervision_policy import SupervisionConfig
from ldo_service.transport.endpoint import MAX_MESSAGE_MB
from ldo_service.viewer.view_config import ViewerConfig, viewer_config


def test_the_default_configuration_gives_the_defaults_of_the_classes() -> None:
    """The classes document the measured reasons of their defaults, so both must agree."""
    config = Config()
    assert actor_parameters(config) == ActorParameters()
    assert stage_parameters(config) == SupervisionConfig()
    assert recording_parameters(config) == RecordConfig()
    assert viewer_config(config.viewer) == ViewerConfig()
    assert config.service.max_message_mb == MAX_MESSAGE_MB
    assert latency_frames(config) == {
        "detector": 3,
        "loop_closer": 10,
        "mapper": 3,
        "optimizer": 3,
        "vlm_labeller": 30,
    }


def test_value_shared_by_several_actors_is_set_once() -> None:
    parameters = actor_parameters(
        load_config(
            settings=(
                "tracker.image.width_px=160",
                "tracker.image.max_depth_m=5",
                "tracker.depth_noise.floor_m=0.01",
                "tracker.alignment.max_iterations=[3, 3]",
                "tracker.features.max_features=500",
                "tracker.relocalization.max_keyframes=77",
                "detector.dynamic_classes=[robot]",
                "service.device=openvino",
                "inference.threads=3",
                "paper.max_depth_gap_m=0.2",
            )
        )
    )
    tracker, loops = parameters.tracker.odometry, parameters.loop_closer.loops
    semantics = parameters.mapper.semantics
    assert tracker.pyramid == loops.pyramid
    assert tracker.pyramid.working_width_px == 160
    assert tracker.align == loops.align
    assert tracker.align.residuals.noise.floor_m == 0.01
    assert tracker.keyframe_database == loops.keyframe_database
    assert tracker.keyframe_database.count == 77
    assert tracker.features.count == loops.features.count == 500
    assert (tracker.features.min_inliers, loops.features.min_inliers) == (15, 12)
    assert tracker.movable == semantics.movable == parameters.loop_closer.movable
    assert tracker.movable.classes == ("robot",)
    networks = parameters.detector.network, parameters.vlm_labeller.dual_encoder
    assert [(one.device, one.threads) for one in networks] == [("openvino", 3)] * 2
    assert parameters.mapper.builder.optimizer.device == "openvino"
    assignment, association = semantics.labelling.assignment, semantics.objects.association
    assert assignment.max_depth_gap_m == association.max_depth_gap_m == 0.2
    foreground = semantics.labelling.foreground
    assert foreground == semantics.naming.trigger.foreground
    assert foreground == loops.verification.landmarks.foreground
