"""Loop closing: subgraphs of keyframes, their descriptors, and the verification of loop candidates.

In the coarse step, `place_database` compares histograms of labels, of the layout of objects and of
visual words. In the fine step, `verification` estimates the pose between two keyframes, and rejects
the candidate if any check fails. `object_presence` then checks that both places show the same
objects. The checks are strict, because a false loop closure damages the map more than a missed one.
See the LDO-SLAM paper, III.C.
"""

from .loop_detector import LoopCandidateResult, LoopDetector, LoopsConfig

__all__ = ["LoopCandidateResult", "LoopDetector", "LoopsConfig"]
