"""Loop closures, and loop candidates with the result of their verification."""

from typing import Literal

from ldo_service.schemas.keyframe import MeasuredPose
from ldo_service.schemas.message import Message, require_count, require_finite

# Source of the relative pose of two subgraphs; empty: no pose was found.
Evidence = Literal["", "landmarks", "features", "map"]
MAX_REASON_LENGTH = 100  # Characters.


class LoopClosure(Message, frozen=True, kw_only=True):
    """Verified relative pose of an old and a new keyframe, published on loop/closure.

    stamp_ns is the stamp of the new keyframe. The pose-graph optimizer accepts the closure only if
    the closure agrees with the other factors of the pose graph.
    """

    pose: MeasuredPose  # Pose of the new keyframe in the frame of the old one, `reference`.
    overlap: float  # Fraction of the new keyframe's surface that the old keyframe sees, 0..1.
    rmse_m: float  # Root mean square distance of the two surfaces along their normals, meters.
    entropy: float = 0.0  # Mean entropy of the matched landmarks, nats.

    def check(self) -> None:
        if self.pose.reference > self.pose.keyframe:
            raise ValueError(
                f"closure of keyframe {self.pose.keyframe} has the newer keyframe "
                f"{self.pose.reference} as reference; the reference must be older"
            )
        require_fraction("overlap", self.overlap)
        require_not_negative("rmse_m", self.rmse_m)
        require_not_negative("entropy", self.entropy)


class LoopCandidate(Message, frozen=True, kw_only=True):
    """Pair of similar subgraphs and the result of their verification, published on loop/candidate.

    A subgraph is a group of three to five consecutive keyframes. stamp_ns is the stamp of
    `keyframe`. Values of verification steps that did not run are 0.
    """

    keyframe: int  # Newest keyframe of the newer subgraph.
    reference: int  # Newest keyframe of the older subgraph.
    keyframes: tuple[int, ...]  # Keyframes of the newer subgraph.
    reference_keyframes: tuple[int, ...]  # Keyframes of the older subgraph.
    similarity: float  # Cosine similarity of the label histograms (TF-IDF), 0..1.
    appearance: float  # Cosine similarity of the visual-word histograms, 0..1.
    evidence: Evidence = ""  # Source of the pose; "": no pose was found.
    inliers: int = 0  # Landmarks or features that agree with the pose.
    divergence: float = 0.0  # Mean KL divergence between matched landmarks, nats.
    entropy: float = 0.0  # Mean entropy of the matched landmarks, nats.
    overlap: float = 0.0  # Fraction 0..1, as in loop/closure.
    rmse_m: float = 0.0  # Meters, as in loop/closure.
    rejected_reason: str = ""  # Reason of the rejection; "": the candidate became a loop closure.

    def check(self) -> None:
        for name in ("keyframe", "reference", "inliers"):
            require_count(name, getattr(self, name))
        for name in ("similarity", "appearance", "overlap"):
            require_fraction(name, getattr(self, name))
        for name in ("divergence", "entropy", "rmse_m"):
            require_not_negative(name, getattr(self, name))
        if len(self.rejected_reason) > MAX_REASON_LENGTH:
            raise ValueError(
                f"rejected_reason has {len(self.rejected_reason)} characters, must have at most "
                f"{MAX_REASON_LENGTH}"
            )
        if not self.rejected_reason and not self.evidence:
            raise ValueError(
                "evidence and rejected_reason are both empty: a candidate without evidence has no "
                "pose and must have a rejected_reason"
            )


def require_fraction(name: str, value: float) -> None:
    """Raise ValueError unless a value is within 0..1."""
    if not 0 <= value <= 1:  # Rejects NaN too.
        raise ValueError(f"{name} is {value:g}, must be within 0..1")


def require_not_negative(name: str, value: float) -> None:
    """Raise ValueError unless a value is finite and at least 0."""
    require_finite(name, (value,))
    if value < 0:
        raise ValueError(f"{name} is {value:g}, must not be negative")
