"""Records in memory of the chunks whose Gaussians are on disk or lost."""

from dataclasses import dataclass, replace

import numpy as np

from ldo_service.geometry import se3


@dataclass(frozen=True, eq=False, slots=True)
class ChunkEntry:
    """Table entry of one offloaded chunk.

    The entry stays in memory while the Gaussians are in a file. The chunk has `count` Gaussians,
    whose ids go from `first_id` to `last_id`, with gaps if `count` is smaller than this range.
    """

    anchor: int  # Id of the anchor keyframe.
    first_id: int
    last_id: int
    count: int
    center_map: np.ndarray  # [3], current center of the bounding sphere in the map frame, meters.
    radius_m: float  # Radius of the bounding sphere.
    # Motions T_new_old [4, 4] of the anchor since the file was written; loading applies them.
    motions: tuple[np.ndarray, ...] = ()

    def moved(self, T_new_old: np.ndarray) -> "ChunkEntry":
        """Return the entry after a motion T_new_old [4, 4] of its anchor keyframe."""
        center = se3.transform(T_new_old, self.center_map)
        return replace(self, center_map=center, motions=(*self.motions, T_new_old))


@dataclass(frozen=True, slots=True)
class LostIdRange:
    """Range of the ids of a damaged chunk, both ends included.

    Ids in this range that are neither in memory nor in another chunk are lost.
    """

    first_id: int
    last_id: int
