"""Records of chunks whose Gaussians are on disk or lost; the records stay in memory."""

from dataclasses import dataclass, replace

import numpy as np

from ldo_service.geometry import se3


@dataclass(frozen=True, eq=False, slots=True)
class ChunkEntry:
    """Table entry of one offloaded chunk, which is the Gaussians of one anchor keyframe in a file.

    The entry stays in memory while the Gaussians are in the file. The chunk has `count` Gaussians.
    Their ids lie between `first_id` and `last_id`, both included; some ids between may be missing.
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
        """Return the entry with a further motion T_new_old [4, 4] of its anchor keyframe."""
        center = se3.transform(T_new_old, self.center_map)
        return replace(self, center_map=center, motions=(*self.motions, T_new_old))


@dataclass(frozen=True, slots=True)
class LostIdRange:
    """Range of Gaussian ids in a damaged chunk; both ends are included.

    Ids in this range that are neither in memory nor in another chunk are lost.
    """

    first_id: int
    last_id: int
