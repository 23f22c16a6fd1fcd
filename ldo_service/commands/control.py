"""ldo control"""

from typing import Annotated, Literal

import tyro

from ldo_service.client import connect
from ldo_service.errors import StageError
from ldo_service.runtime.zenoh_transport import DEFAULT_ENDPOINT

from .options import Endpoint, Robot

Verb = Annotated[
    Literal["pause", "resume", "save", "reset"],
    tyro.conf.Positional,
    tyro.conf.arg(
        metavar="VERB",
        help="pause: leave frames out; resume: take them again; save: write every actor's state "
        "now; reset: begin anew with an empty map",
    ),
]


def control(verb: Verb, robot: Robot = "robot", endpoint: Endpoint = DEFAULT_ENDPOINT) -> None:
    """Pause, resume, save or reset a running service; done when all its actors have done it.

    Exit code 4 when an actor did not; the answer names it.

      ldo control reset
    """
    with connect(robot, endpoint) as service:
        answer = service.control(verb)
    if not answer.ok:
        raise StageError(answer.text)
    print(answer.text)
