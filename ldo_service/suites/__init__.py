"""Suites: lists of runs, sources x variants x seeds, each evaluated and compared in a table.

The YAML files of this package are the tables of the paper that LDO-SLAM implements, its sensitivity
analysis and its ablation. `published` in them has the values that the paper prints for its own
method and for others.
"""

from .runner import Outcome, SuiteRunner
from .suite import FIGURES, Judged, Suite, SuiteRun, known_suites, load_suite
from .tables import markdown

__all__ = [
    "FIGURES",
    "Judged",
    "Outcome",
    "Suite",
    "SuiteRun",
    "SuiteRunner",
    "known_suites",
    "load_suite",
    "markdown",
]
