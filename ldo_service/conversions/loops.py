"""Conversions between messages and internal types: loop closures and loop candidates."""

from ldo_service.loop_closing import LoopCandidateResult
from ldo_service.schemas import (
    LoopCandidate,
    LoopClosure,
)

from .poses import relative_pose_to_message


def loop_closure_to_message(result: LoopCandidateResult) -> LoopClosure:
    """Return the loop-closure message of an accepted loop candidate.

    Raises:
        ValueError: The candidate was rejected.
    """
    if result.closure is None:
        raise ValueError(
            "the loop candidate has no loop closure, because it was rejected "
            f"(rejected_reason={result.check.rejected_reason!r}). Convert only accepted candidates."
        )
    return LoopClosure(
        stamp_ns=result.check.proposal.new.stamp_ns,
        pose=relative_pose_to_message(result.closure),
        overlap=result.check.overlap,
        rmse_m=result.check.rmse_m,
        entropy=result.check.proposal.semantics.entropy,
    )


def loop_candidate_to_message(result: LoopCandidateResult) -> LoopCandidate:
    """Return the message of a loop candidate, accepted or rejected."""
    check, old, new = result.check, result.match.subgraph, result.new
    proposal = check.proposal
    return LoopCandidate(
        stamp_ns=new.stamp_ns,
        keyframe=new.keyframes[-1],
        reference=old.keyframes[-1],
        keyframes=new.keyframes,
        reference_keyframes=old.keyframes,
        similarity=result.match.similarity,
        appearance=result.match.appearance,
        evidence=proposal.evidence,
        inliers=proposal.inliers,
        divergence=proposal.semantics.divergence,
        entropy=proposal.semantics.entropy,
        overlap=check.overlap,
        rmse_m=check.rmse_m,
        rejected_reason=check.rejected_reason,
    )
