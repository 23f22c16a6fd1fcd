"""What a person or a program asks of the whole service, and what it answers."""

from ldo_service.schemas.message import Message


class ControlRequest(Message, frozen=True, kw_only=True):
    """control: the payload of a query. stamp_ns is the asker's clock, or 0.

    pause    frames are left out and counted from now on
    resume   frames are taken again
    save     every actor writes its whole state now
    reset    every actor begins anew, with an empty state and a new epoch
    """

    command: str  # another one is answered with the list of those there are


class ControlAnswer(Message, frozen=True, kw_only=True):
    """The reply, sent when all actors have done it. stamp_ns is that of the request."""

    ok: bool
    message: str  # one paragraph for people: what was done, or what is wrong and what to do
