"""Lists of runs that make a table: sources x variants x seeds, each run and judged by itself.

The files beside this one are the tables of the paper that LDO-SLAM implements, its sensitivity and
its ablation; `published` in them are the figures that the paper prints, of its own and of others.
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
