"""Configuration: settings with defaults, units and reasons, converted to the actors' parameters.

A configuration file lists only the settings that differ from their defaults:

    tracker:
      hold_out: 5
    service:
      process_actors: [optimizer, mapper]

An unknown setting causes an error, which names the most similar known setting. `ldo config` prints
all public settings, and the advanced settings that differ from their defaults. `ldo config --all`
prints all settings.
"""

from .loading import checked, config_of, known_presets, load_config
from .parameters import (
    actor_parameters,
    latency_frames,
    recording_parameters,
    stage_parameters,
)
from .printing import config_yaml, explained_yaml
from .sections import Config

__all__ = [
    "Config",
    "actor_parameters",
    "checked",
    "config_of",
    "config_yaml",
    "explained_yaml",
    "known_presets",
    "latency_frames",
    "load_config",
    "recording_parameters",
    "stage_parameters",
]
