"""Commands to the whole service, and the replies to them."""

from ldo_service.schemas.message import Message


class ControlRequest(Message, frozen=True, kw_only=True):
    """Command to the service, sent as the payload of a Zenoh query on the topic control.

    stamp_ns is the time of sending, by the clock of the sender; it may also be 0. The commands are:

    pause    the service drops and counts all frames from now on
    resume   the service accepts frames again
    save     every actor writes a checkpoint of its whole state now
    reset    every actor restarts with an empty state, as if it started for the first time
    """

    command: str  # An unknown command is answered with the list of known commands.


class ControlAnswer(Message, frozen=True, kw_only=True):
    """Reply to a command, sent after all actors have executed it.

    stamp_ns is the stamp of the request.
    """

    ok: bool
    message: str  # One paragraph for users: what was done, or what is wrong and what to do.
