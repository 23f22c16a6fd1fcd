"""What the loop closer says: pairs of keyframes that show one place."""

from typing import Literal

from ldo_service.schemas.keyframe import MeasuredPose
from ldo_service.schemas.message import Message, require_count, require_finite

Evidence = Literal["", "landmarks", "features", "map"]
MAX_REASON_LENGTH = 100  # characters


class LoopClosure(Message, frozen=True, kw_only=True):
    """loop/closure: an old keyframe and a new one, with the verified pose between them. stamp_ns is
    that of the new one.

    The optimizer believes it as far as the other measurements allow.
    """

    pose: MeasuredPose  # the new keyframe in the old one, `reference`
    overlap: float  # 0..1, share of the new keyframe's surface that the old one sees
    rmse_m: float  # between the two surfaces, along their normals
    entropy: float = 0.0  # nats, mean over the objects it rests on

    def check(self) -> None:
        if self.pose.reference > self.pose.keyframe:
            raise ValueError(
                f"keyframe {self.pose.keyframe} closes a loop with the newer {self.pose.reference}"
            )
        require_fraction("overlap", self.overlap)
        require_not_negative("rmse_m", self.rmse_m)
        require_not_negative("entropy", self.entropy)


class LoopCandidate(Message, frozen=True, kw_only=True):
    """loop/candidate: two subgraphs that look alike, and what came of it. stamp_ns is that of the
    newest keyframe. What was not reached is 0."""

    keyframe: int  # the newest keyframe of the newer subgraph
    reference: int  # that of the older one
    keyframes: tuple[int, ...]  # of the newer subgraph
    reference_keyframes: tuple[int, ...]  # of the older one
    similarity: float  # cosine of what they hold (TF-IDF), 0..1
    appearance: float  # how alike their images are, 0..1
    evidence: Evidence = ""  # what the pose was found from; "": none was found
    inliers: int = 0  # landmarks or features that agree on it
    divergence: float = 0.0  # nats, mean KL between the landmarks that were matched
    entropy: float = 0.0  # nats, their mean
    overlap: float = 0.0  # as of a closure
    rmse_m: float = 0.0
    rejected_reason: str = ""  # why; "": it became a closure

    def check(self) -> None:
        for name in ("keyframe", "reference", "inliers"):
            require_count(name, getattr(self, name))
        for name in ("similarity", "appearance", "overlap"):
            require_fraction(name, getattr(self, name))
        for name in ("divergence", "entropy", "rmse_m"):
            require_not_negative(name, getattr(self, name))
        if len(self.rejected_reason) > MAX_REASON_LENGTH:
            raise ValueError(
                f"a reason of {len(self.rejected_reason)} characters: at most {MAX_REASON_LENGTH}"
            )
        if not self.rejected_reason and not self.evidence:
            raise ValueError("a candidate without evidence cannot be accepted")


def require_fraction(name: str, value: float) -> None:
    if not 0 <= value <= 1:  # NaN is refused too
        raise ValueError(f"{name} is {value:g}, must be within 0..1")


def require_not_negative(name: str, value: float) -> None:
    require_finite(name, (value,))
    if value < 0:
        raise ValueError(f"{name} is {value:g}, must not be negative")
