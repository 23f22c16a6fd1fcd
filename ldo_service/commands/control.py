"""ldo control"""

from typing import Annotated, Literal

import tyro

from ldo_service.client import Client, connect
from ldo_service.errors import ConfigError, StageError
from ldo_service.schemas.map import MAX_ITERATIONS
from ldo_service.transport.zenoh_transport import DEFAULT_ENDPOINT

from .options import EndpointAddress, KeysFolder, Robot

Verb = Annotated[
    Literal["pause", "resume", "save", "reset", "refine", "add-label"],
    tyro.conf.Positional,
    tyro.conf.arg(
        metavar="VERB",
        help="pause: leave frames out; resume: take them again; save: write every actor's state "
        "now; reset: begin anew with an empty map; refine: fit the map further; add-label: "
        "choose from NAME too when regions are named",
    ),
]
Name = Annotated[
    str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME", help="of add-label, such as samovar")
]
Iterations = Annotated[
    int, tyro.conf.arg(metavar="N", help=f"of refine, at most {MAX_ITERATIONS} at a time")
]


def control(
    verb: Verb,
    name: Name = "",
    robot: Robot = "robot",
    endpoint: EndpointAddress = DEFAULT_ENDPOINT,
    keys: KeysFolder = None,
    iterations: Iterations = 200,
) -> None:
    """Pause, resume, save or reset a running service; done when all its actors have done it.

    Exit code 4 when an actor did not; the answer names it. `refine` asks the mapper alone and does
    not wait: it fits the map to its keyframes before it takes the next one.

      ldo control reset
      ldo control refine --iterations 500
      ldo control add-label "fire extinguisher"
    """
    if bool(name) != (verb == "add-label"):
        raise ConfigError("`ldo control add-label NAME` takes a name, and no other verb does.")
    with connect(robot, endpoint, keys) as service:
        if verb == "refine":
            ask_to_refine(service, iterations)
        elif verb == "add-label":
            names = service.add_label(name)
            print(f"{name} is added: regions are named from {len(names)} names.")
        else:
            run_control_verb(service, verb)


def ask_to_refine(service: Client, iterations: int) -> None:
    """Raises ConfigError for a number that is refused."""
    try:
        service.refine(iterations)
    except ValueError as error:
        raise ConfigError(f"--iterations {iterations}: {error}.") from error
    print(f"the mapper was asked for {iterations} iterations.")


def run_control_verb(service: Client, verb: str) -> None:
    """Raises StageError when an actor does not."""
    answer = service.control(verb)
    if not answer.ok:
        raise StageError(answer.message)
    print(answer.message)
