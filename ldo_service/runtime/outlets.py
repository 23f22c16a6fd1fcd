"""All outlets of one actor."""

from collections.abc import Iterable, Sequence

from ldo_service.schemas import Message, OutputCount
from ldo_service.schemas.topics import Topic

from .links import OutletPast
from .outlet import Outlet
from .step import Produced


class Outlets:
    """What a step made is held by each, released when the step is saved, or taken back."""

    def __init__(self, outlets: Iterable[Outlet] = ()) -> None:
        self._all = {outlet.topic.message: outlet for outlet in outlets}

    def __getitem__(self, message: type[Message]) -> Outlet:
        return self._all[message]

    @property
    def never_wait(self) -> bool:
        """Whether one of them is of a port that never waits."""
        return any(outlet.port.never_wait for outlet in self._all.values())

    @property
    def have_expected(self) -> bool:
        """Whether some consumer must not miss a message."""
        return any(outlet.past() for outlet in self._all.values())

    def room(self) -> dict[Topic, int]:
        """Of the ports that never wait, whose actor looks before it makes something."""
        return {
            outlet.topic: outlet.room() for outlet in self._all.values() if outlet.port.never_wait
        }

    def past(self) -> dict[str, OutletPast | None]:
        return {outlet.topic.name: outlet.past() for outlet in self._all.values()}

    def hold(self, produced: Sequence[Produced]) -> None:
        for out in produced:
            self._all[type(out.message)].hold(out.message, out.body)

    async def release(self, *, is_saved: bool = True) -> None:
        """Send what is held; of a step that is not saved what nobody has to get."""
        for outlet in self._all.values():
            if is_saved or outlet.past() is None:
                await outlet.release()

    def take_back(self) -> None:
        for outlet in self._all.values():
            outlet.take_back()

    async def flush(self) -> None:
        for outlet in self._all.values():
            await outlet.flush()

    def renew(self, epoch: int) -> None:
        for outlet in self._all.values():
            outlet.renew(epoch)

    def check_windows(self) -> None:
        for outlet in self._all.values():
            outlet.check_windows()

    def statistics(self) -> tuple[OutputCount, ...]:
        return tuple(outlet.statistics() for outlet in self._all.values())

    def close(self) -> None:
        for outlet in self._all.values():
            outlet.close()
