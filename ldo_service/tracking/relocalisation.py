"""Finding a lost camera among remembered keyframes. Conventions: `ldo_service.geometry`."""

from collections.abc import Sequence
from dataclasses import dataclass

from ldo_service.errors import ConfigError
from ldo_service.geometry import se3

from .align import AlignConfig
from .candidates import Candidate, attempt
from .features import FeatureConfig, FeaturePose, detect, estimate_pose
from .judgement import History, JudgementConfig, Status, judge
from .keyframes import Keyframe
from .pyramid import Pyramid


@dataclass(frozen=True, slots=True)
class RelocalisationConfig:
    memory: int = 8  # keyframes kept: a metre or two of motion; older places are the loop closer's
    attempts: int = 2  # direct alignments per lost frame, the best feature poses first

    def __post_init__(self) -> None:
        if min(self.memory, self.attempts) < 1:
            raise ConfigError("memory and attempts must be at least 1.")


def relocalise(
    memory: Sequence[Keyframe],
    view: Pyramid,
    history: History,
    judgement: JudgementConfig,
    features: FeatureConfig,
    align: AlignConfig,
    config: RelocalisationConfig,
) -> tuple[Keyframe, Candidate] | None:
    """The keyframe that a view surely shows and its alignment to it: ORB, PnP RANSAC, then direct.

    Judged more strictly than tracking, because no prediction speaks for it.
    """
    for keyframe, pose in _places(memory, view, features)[: config.attempts]:
        guess = se3.inverse(pose.T_camera_reference)
        candidate = attempt(keyframe, view, guess, "relocalised", align)
        verdict = judge(candidate.alignment, None, history, Status.LOST, judgement)
        if verdict is Status.OK:
            return keyframe, candidate
    return None


def _places(
    memory: Sequence[Keyframe], view: Pyramid, config: FeatureConfig
) -> list[tuple[Keyframe, FeaturePose]]:
    """Keyframes with a feature pose, most inliers first, of equals the newest."""
    seen = detect(view, config)
    poses = [
        (k, estimate_pose(k.features(config), seen, view.camera, config)) for k in reversed(memory)
    ]
    return sorted(((k, p) for k, p in poses if p is not None), key=lambda kp: -kp[1].inliers)
