"""Suites: runs of several sequences, variants and seeds, evaluated and compared in a table.

The YAML files of this package are built-in suites. They reproduce the tables of the LDO-SLAM paper,
including the sensitivity analysis and the ablation. The key `published` holds the numbers that
the paper reports, for its own method and for other methods.
"""

from .runner import Outcome, SuiteRunner
from .suite import FIGURES, EvaluatedRun, Suite, SuiteRun, known_suites, load_suite
from .tables import markdown

__all__ = [
    "FIGURES",
    "EvaluatedRun",
    "Outcome",
    "Suite",
    "SuiteRun",
    "SuiteRunner",
    "known_suites",
    "load_suite",
    "markdown",
]
