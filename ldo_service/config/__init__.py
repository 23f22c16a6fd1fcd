"""Configuration: every setting, its default, its unit and its reason.

A configuration file lists only what differs:

    tracker:
      hold_out: 5
    service:
      spawned: [optimizer, mapper]

An unknown key is an error that names the nearest one; `ldo config` prints the whole.
"""

from .loading import config_of, config_yaml, explained_yaml, load_config
from .sections import Config

__all__ = ["Config", "config_of", "config_yaml", "explained_yaml", "load_config"]
