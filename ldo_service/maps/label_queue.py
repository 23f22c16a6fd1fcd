"""Queue of label requests, which ask the labeller for the names of image regions."""

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

from ldo_service.conversions.objects import label_request_to_message
from ldo_service.gaussians.map_builder import MapBuilder
from ldo_service.regions.region import Region
from ldo_service.schemas import LabelRequest, decode, encode
from ldo_service.semantics.ordered_semantics import OrderedSemantics

# Maximum number of waiting requests, about 10 kB each. The map keeps at most as many requests
# pending: three for each of 32 regions.
MAX_WAITING = 96
# Maximum number of regions for which the largest shown surface is stored, 16 bytes each.
MAX_REGIONS = 4096


class WaitingRequest(NamedTuple):
    """Label request that waits for the labeller."""

    request: LabelRequest
    surface_m2: float  # Area of the region's surface that the view of the request shows.


class LabelRequestQueue:
    """Queue of label requests, at most one for each region.

    A request waits until the labeller can receive it. If the labeller can receive all waiting
    requests, the oldest request is sent first. Otherwise, the request with the most new surface is
    sent first, so that large objects get their labels first. The new surface is the area of the
    region in the view of the request, minus the largest area in a sent request of the same region.
    """

    def __init__(self) -> None:
        self._waiting: dict[int, WaitingRequest] = {}  # Keys are regions; the oldest is first.
        # Largest surface that a sent request showed, by region, square meters.
        self._shown_m2: dict[int, float] = {}

    def __len__(self) -> int:
        return len(self._waiting)

    def __contains__(self, region: int) -> bool:
        return region in self._waiting

    def add(self, request: LabelRequest, surface_m2: float) -> list[LabelRequest]:
        """Add a request, and return the requests that leave the queue without being sent.

        The new request replaces a waiting request of the same region. If the queue is then too
        long, the request with the least new surface is dropped (see `LabelRequestQueue`).

        Args:
            request: Label request of a region.
            surface_m2: Area of the region's surface in the view of the request, square meters.
        """
        replaced = self._waiting.pop(request.region, None)
        self._waiting[request.region] = WaitingRequest(request, surface_m2)
        displaced = [replaced.request] if replaced else []
        while len(self._waiting) > MAX_WAITING:
            least = min(self._waiting.values(), key=self._new_m2)
            displaced.append(self._waiting.pop(least.request.region).request)
        return displaced

    def take(self, room: int) -> list[LabelRequest]:
        """Remove and return at most `room` requests to send now."""
        if room >= len(self._waiting):
            chosen = list(self._waiting.values())
        else:
            # The sort is stable: of requests with equal new surface, the oldest comes first.
            best = sorted(self._waiting.values(), key=lambda one: -self._new_m2(one))
            chosen = best[: max(0, room)]
        for one in chosen:
            region = one.request.region
            del self._waiting[region]
            shown_m2 = self._shown_m2.pop(region, 0.0)
            self._shown_m2[region] = max(shown_m2, one.surface_m2)
        while len(self._shown_m2) > MAX_REGIONS:
            del self._shown_m2[next(iter(self._shown_m2))]
        return [one.request for one in chosen]

    def _new_m2(self, one: WaitingRequest) -> float:
        return max(0.0, one.surface_m2 - self._shown_m2.get(one.request.region, 0.0))

    def pack(self) -> dict[str, Sequence[object]]:
        """Return the queue as plain values for a checkpoint."""
        return {
            "waiting": [(encode(one.request), one.surface_m2) for one in self._waiting.values()],
            "shown": list(self._shown_m2.items()),
        }

    @staticmethod
    def unpack(packed: dict[str, Sequence[tuple]]) -> "LabelRequestQueue":
        """Restore a queue from the values that `pack` returned."""
        out = LabelRequestQueue()
        for body, surface_m2 in packed["waiting"]:
            request = decode(body, LabelRequest)
            out._waiting[request.region] = WaitingRequest(request, surface_m2)
        out._shown_m2 = {int(region): float(shown_m2) for region, shown_m2 in packed["shown"]}
        return out


class LabelRequests:
    """Queued label requests of a map; each asks the labeller for the name of an image region.

    A request that is sent or withdrawn is marked so in the semantics of the map.

    Attributes:
        queue: Requests that wait until the labeller can receive them.
    """

    def __init__(self, semantics: OrderedSemantics, map_: MapBuilder) -> None:
        """Start without requests.

        Args:
            semantics: Semantics that make the requests.
            map_: The map, with the cameras of its keyframes.
        """
        self.queue = LabelRequestQueue()
        self._semantics, self._map = semantics, map_

    def add(self, regions: Iterable[Region], stamp_ns: int) -> None:
        """Queue one request for each region, and withdraw the requests that the queue drops."""
        for region in regions:
            request = label_request_to_message(region, stamp_ns)
            surface_m2 = region.surface_m2(self._map.views.cameras.get(region.keyframe))
            for one in self.queue.add(request, surface_m2):
                is_replaced = one.region in self.queue
                self._semantics.withdraw(one.region, one.keyframe, is_replaced=is_replaced)

    def take(self, room: int) -> Iterator[LabelRequest]:
        """Remove and yield at most `room` requests to send now."""
        for request in self.queue.take(room):
            self._semantics.mark_sent(request.region)
            yield request
