"""Configured neural networks of a run: their names, and a check before the run."""

from ldo_service.actors.detector import require_detector
from ldo_service.actors.vlm_labeller import require_labeller
from ldo_service.config import Config, actor_parameters


def require_usable_networks(config: Config) -> None:
    """Check that the configured networks can be used.

    The live service does not call this function. Instead, the service only warns if it cannot use
    a network.

    Raises:
        ConfigError: A network cannot be used.
    """
    parameters = actor_parameters(config)
    require_detector(parameters.detector)
    require_labeller(parameters.vlm_labeller)


def labelled_by(config: Config) -> dict[str, str]:
    """Return the names of the detector and the labeller of a run; a missing one has the name ""."""
    labeller = config.vlm_labeller.model or config.vlm_labeller.url
    return {"detector": config.detector.model, "labeller": labeller}
