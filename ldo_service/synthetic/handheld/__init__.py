"""Simulator of a hand-held RGB-D camera with the effects of real cameras and exact ground truth.

Examples of sequence names:

synthetic:tour-handheld              all effects, with a Kinect's depth
synthetic:tour-handheld:blur         motion blur alone, with exact depth
synthetic:tour-handheld:all+tof@3    all effects with a time-of-flight camera, and seed 3
synthetic:tour-handheld:none         the same motion without any effect
"""

from .effects import ALL, Effects
from .sequence import MARK, NAMED, HandheldConfig, HandheldSequence

__all__ = ["ALL", "MARK", "NAMED", "Effects", "HandheldConfig", "HandheldSequence"]
