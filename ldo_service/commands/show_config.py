"""Command `ldo config`."""

from typing import Annotated

from ldo_service.config import explained_yaml, load_config

from .options import ConfigFile, Settings, argument


def show_config(
    config: ConfigFile = None,
    set: Settings = (),
    all_: Annotated[
        bool, argument(name="all", help="print advanced settings too; they may change")
    ] = False,
) -> None:
    """Print the effective configuration as YAML, with a comment on each setting.

    Without --all the output has the public settings, and the advanced ones that differ from their
    defaults.

      ldo config > my.yaml            then delete what you do not change
      ldo run SOURCE --out DIR --config my.yaml
    """
    print(explained_yaml(load_config(config, set), with_advanced=all_), end="")
