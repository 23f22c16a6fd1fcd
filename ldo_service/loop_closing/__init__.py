"""Loop closing: subgraphs of keyframes, their descriptors, and the verification of loop candidates.

Coarse step: `place_database` compares histograms of labels, of their layout and of visual words.
Fine step: `verification` estimates the pose between two keyframes and rejects it on any
contradiction. Paper, III.C; a false closure costs more than a missed one.
"""

from .loop_detector import LoopCandidateResult, LoopDetector, LoopsConfig

__all__ = ["LoopCandidateResult", "LoopDetector", "LoopsConfig"]
