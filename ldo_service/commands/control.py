"""Command `ldo control`: control a running service, refine its map, or add a label."""

from typing import Annotated, Literal

import tyro

from ldo_service.client import Client, connect
from ldo_service.errors import ConfigError, StageError
from ldo_service.schemas.map import MAX_ITERATIONS
from ldo_service.transport.zenoh_transport import DEFAULT_ENDPOINT

from .options import EndpointAddress, KeysFolder, Robot, argument

Verb = Annotated[
    Literal["pause", "resume", "save", "reset", "refine", "add-label"],
    tyro.conf.Positional,
    argument(
        metavar="VERB",
        help="pause: drop all frames; resume: process frames again; save: write every actor's "
        "state now; reset: start again with an empty map; refine: optimize the map further; "
        "add-label: add NAME to the names that the labeller chooses from",
    ),
]
Name = Annotated[
    str,
    tyro.conf.Positional,
    argument(metavar="NAME", help="label that add-label adds, such as samovar"),
]
Iterations = Annotated[
    int,
    argument(metavar="N", help=f"iterations of refine, at most {MAX_ITERATIONS} per command"),
]


def control(
    verb: Verb,
    name: Name = "",
    robot: Robot = "robot",
    endpoint: EndpointAddress = DEFAULT_ENDPOINT,
    keys: KeysFolder = None,
    iterations: Iterations = 200,
) -> None:
    """Pause, resume, save or reset a running service, refine its map, or add a label.

    pause, resume, save and reset return when every actor has executed them. If an actor does not
    execute the command, an error names the actor and the exit code is 4.

    `refine` only sends a request to the mapper and returns immediately. The mapper runs the
    iterations of the refinement before it takes its next keyframe.

      ldo control reset
      ldo control refine --iterations 500
      ldo control add-label "fire extinguisher"
    """
    if verb == "add-label" and not name:
        raise ConfigError(
            "`ldo control add-label` needs the NAME of the label, as in `ldo control add-label "
            "samovar`."
        )
    if verb != "add-label" and name:
        raise ConfigError(f"`ldo control {verb}` takes no NAME, but {name!r} is given. Remove it.")
    with connect(robot, endpoint, keys) as service:
        if verb == "refine":
            ask_to_refine(service, iterations)
        elif verb == "add-label":
            names = service.add_label(name)
            print(f"{name} is added: the labeller chooses from {len(names)} names.")
        else:
            run_control_verb(service, verb)


def ask_to_refine(service: Client, iterations: int) -> None:
    """Request refinement iterations from the mapper.

    Raises:
        ConfigError: The number of iterations is out of bounds.
    """
    try:
        service.refine(iterations)
    except ValueError as error:
        raise ConfigError(f"--iterations {iterations}: {error}.") from error
    print(f"{iterations} iterations are requested from the mapper.")


def run_control_verb(service: Client, verb: str) -> None:
    """Run a control command in all actors and print the result.

    Raises:
        StageError: An actor did not execute the command.
    """
    answer = service.control(verb)
    if not answer.ok:
        raise StageError(answer.message)
    print(answer.message)
