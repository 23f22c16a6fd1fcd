"""Types of settings with their limits, and the marker of advanced settings."""

from dataclasses import field
from typing import Annotated, TypeVar

from msgspec import Meta

PositiveInt = Annotated[int, Meta(ge=1)]
NonNegativeInt = Annotated[int, Meta(ge=0)]
PositiveFloat = Annotated[float, Meta(gt=0)]
NonNegativeFloat = Annotated[float, Meta(ge=0)]
Ratio = Annotated[float, Meta(ge=0, le=1)]
PositiveRatio = Annotated[float, Meta(gt=0, le=1)]
OpenRatio = Annotated[float, Meta(gt=0, lt=1)]

ADVANCED = "advanced"  # Key in the metadata of a field.

T = TypeVar("T")


def advanced(default: T) -> T:
    """Declare a setting that only `ldo config --all` prints and that may change in any release.

    Args:
        default: Default of the setting.
    """
    return field(default=default, metadata={ADVANCED: True})
