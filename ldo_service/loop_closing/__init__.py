"""Recognising places: subgraphs of keyframes, what they hold, and whether two of them are one.

Coarse: `place_database` compares histograms of names, of their layout and of visual words.
Fine: `verification` finds the pose between two keyframes and refuses it wherever anything speaks
against it. Paper, III.C; a false closure costs more than a missed one.
"""

from .loop_detector import LoopCandidateResult, LoopDetector, LoopsConfig

__all__ = ["LoopCandidateResult", "LoopDetector", "LoopsConfig"]
