"""Effects of real cameras that the simulator can switch on, one by one."""

from dataclasses import dataclass, fields
from typing import Literal, get_args

from ldo_service.errors import DataError

DepthSensor = Literal["exact", "kinect", "tof", "stereo"]


@dataclass(frozen=True, slots=True)
class Effects:
    """Effects of a simulated camera; none by default."""

    rolling_shutter: bool = False  # The rows of an image are exposed one after the other.
    late_depth: bool = False  # Depth is measured later than color.
    blur: bool = False  # Motion blur, because the camera moves during the exposure.
    distortion: bool = False  # Lens distortion of the color camera.
    vignetting: bool = False  # The corners of the color image are darker.
    exposure: bool = False  # Automatic exposure and white balance, and sensor noise.
    depth_bias: bool = False  # Smooth depth error over the image.
    depth: DepthSensor = "exact"  # Depth camera, which determines noise, holes and errors at edges.


ALL = Effects(True, True, True, True, True, True, True, "kinect")
SWITCHES = {f.name.replace("_", "-"): f.name for f in fields(Effects) if f.name != "depth"}
SENSORS = tuple(name for name in get_args(DepthSensor) if name != "exact")


def parse_effects(text: str, name: str) -> Effects:
    """Return the effects that are listed after `-handheld`, such as `:blur+tof`.

    Args:
        text: A colon and names joined by `+`. The names `all` and `none` are allowed; `all`
            includes the depth camera `kinect`. If the text names several depth cameras, the last
            one applies. Empty text means `:all`.
        name: Name of the sequence, for the error message.

    Raises:
        DataError: If an effect is unknown.
    """
    if not text:
        return ALL
    values: dict[str, object] = {}
    for word in text.removeprefix(":").split("+"):
        if word == "all":
            values |= {f.name: getattr(ALL, f.name) for f in fields(Effects)}
        elif word in SWITCHES:
            values[SWITCHES[word]] = True
        elif word in SENSORS:
            values["depth"] = word
        elif word != "none":
            known = ", ".join(("all", "none", *SWITCHES, *SENSORS))
            raise DataError(f"synthetic:{name}: unknown effect {word!r}. Choose from {known}.")
    return Effects(**values)  # type: ignore[arg-type]
