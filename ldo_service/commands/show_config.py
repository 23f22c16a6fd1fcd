"""Command `ldo config`: print the effective configuration with comments."""

from typing import Annotated

from ldo_service.config import explained_yaml, load_config

from .options import ConfigFile, Preset, Settings, argument, with_preset


def show_config(
    preset: Preset = "",
    config: ConfigFile = None,
    set: Settings = (),
    all_: Annotated[
        bool, argument(name="all", help="print all advanced settings too; releases may change them")
    ] = False,
) -> None:
    """Print the effective configuration as YAML, with a comment on each setting.

    Without --all, the command prints all public settings, and only those advanced settings that
    differ from their defaults. --config reads back what the command prints.

      ldo config > my.yaml            then delete what you do not change
      ldo run SOURCE --out DIR --config my.yaml
    """
    print(explained_yaml(load_config(config, with_preset(set, preset)), with_advanced=all_), end="")
