"""Loop closing: subgraphs of keyframes, their descriptors, and the verification of loop candidates.

Coarse step: `place_database` compares histograms of labels, of their layout and of visual words.
Fine step: `verification` estimates the pose between two keyframes, and rejects the candidate if any
check fails. `object_presence` then looks for the objects of the map. The checks are strict, because
a false loop closure damages the map more than a missed one. See the LDO-SLAM paper, III.C.
"""

from .loop_detector import LoopCandidateResult, LoopDetector, LoopsConfig

__all__ = ["LoopCandidateResult", "LoopDetector", "LoopsConfig"]
