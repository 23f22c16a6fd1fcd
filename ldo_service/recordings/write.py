"""The journal of a service's actor, and what it says about itself."""

import json
from pathlib import Path

from ldo_service import kernels
from ldo_service.config import Config, config_yaml
from ldo_service.errors import ConfigError
from ldo_service.runtime.recorder import Recorder
from ldo_service.runtime.recording import new_path
from ldo_service.versions import versions


def open_recorder(folder: Path, actor: str, robot: str, config: Config) -> Recorder:
    """A new file for the actor's life in this process. Raises ConfigError."""
    about = {
        "actor": actor,
        "robot": robot,
        "config": config_yaml(config),
        "isa": kernels.isa(),
        "versions": json.dumps(versions()),
    }
    try:
        folder.mkdir(parents=True, exist_ok=True)
        return Recorder(new_path(folder, actor), about, config.record)
    except OSError as error:
        raise ConfigError(f"{folder} cannot be recorded to: {error.strerror}.") from error
