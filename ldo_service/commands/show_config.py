"""ldo config"""

from ldo_service.config import explained_yaml, load_config

from .options import ConfigFile, Settings


def show_config(
    config: ConfigFile = None,
    set: Settings = (),
) -> None:
    """Print the whole effective configuration as YAML, the reason for each default beside it.

    ldo config > my.yaml            then delete what you do not change
    ldo run SOURCE --out DIR --config my.yaml
    """
    print(explained_yaml(load_config(config, set)), end="")
