"""The design card as data: every actor with its ports, and what it is made from.

The drawing and the table of topics in README are printed from here (`ldo topics --markdown`).
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

from ldo_service.actors.detector import Detector
from ldo_service.actors.frame_source import FrameSource
from ldo_service.actors.localiser import LocalisingTracker
from ldo_service.actors.loop_closer import LoopCloser
from ldo_service.actors.mapper import Mapper
from ldo_service.actors.optimizer import Optimizer
from ldo_service.actors.tracker import Tracker
from ldo_service.actors.vlm_labeller import VlmLabeller
from ldo_service.config import Config
from ldo_service.errors import ConfigError
from ldo_service.runtime import Actor, In, Latest, Lossless, Out
from ldo_service.schemas import topics as t


@dataclass(frozen=True, slots=True)
class Box:
    """An actor of the design, with all its ports.

    Without `make` it is drawn and left out of every run. An actor that runs may not have all of
    its ports yet: `built` is the class that says which.
    """

    name: str
    does: str
    inputs: tuple[In, ...]
    outputs: tuple[Out, ...]
    make: Callable[[Config], Actor] | None = None
    built: type[Actor] | None = None


def _built(
    actor: type[Actor],
    does: str,
    make: Callable[[Config], Actor],
    later: tuple[In | Out, ...] = (),
) -> Box:
    """An actor that runs; `later` are ports of the design that come with their use."""
    inputs = tuple(port for port in later if isinstance(port, In))
    outputs = tuple(port for port in later if isinstance(port, Out))
    ports = actor.inputs + inputs, actor.outputs + outputs
    return Box(actor.name, does, *ports, make, built=actor)


GRAPH: tuple[Box, ...] = (
    _built(
        FrameSource,
        "checks and rectifies camera frames",
        lambda config: FrameSource(config.frame_source),
    ),
    _built(
        Tracker,
        "finds the camera's pose",
        lambda config: (LocalisingTracker if config.tracker.localise else Tracker)(config.tracker),
    ),
    _built(
        Detector,
        "finds objects of known classes",
        lambda config: Detector(config.detector),
    ),
    _built(
        VlmLabeller,
        "names what the detector does not know",
        lambda config: VlmLabeller(config.vlm_labeller),
    ),
    _built(
        Mapper,
        "keeps the map of Gaussians, and what stands in it",
        lambda config: Mapper(config.mapper, has_labeller=config.vlm_labeller.is_chosen),
    ),
    _built(
        LoopCloser,
        "recognises places",
        lambda config: LoopCloser(config.loop_closer),
        later=(In(t.MAP_OBJECTS, Latest(1)),),
    ),
    _built(
        Optimizer,
        "makes keyframe poses agree",
        lambda config: Optimizer(config.optimizer),
    ),
)

# The actors of a run, with the ports that they have today.
RUNNING: tuple[Box, ...] = tuple(
    replace(box, inputs=box.built.inputs, outputs=box.built.outputs) for box in GRAPH if box.built
)


def box_named(name: str) -> Box:
    """Raises ConfigError for a name that is not in the graph, or not in runs yet."""
    for box in GRAPH:
        if box.name == name and box.make is not None:
            return box
        if box.name == name:
            raise ConfigError(f"actor {name} is declared and not part of this version.")
    names = ", ".join(box.name for box in RUNNING)
    raise ConfigError(f"there is no actor {name!r}. The actors are {names}.")


def make_actors(config: Config) -> list[Actor]:
    """All running actors, producers first."""
    return [box.make(config) for box in RUNNING if box.make is not None]


def producer_of(topic: t.Topic) -> str:
    for box in GRAPH:
        if any(out.topic is topic for out in box.outputs):
            return box.name
    if topic is t.HEALTH:
        return "every stage"
    if topic is t.CONTROL:
        return "outside"
    outside = (*t.FROM_OUTSIDE, *t.FROM_ODOMETRY, *t.FROM_OPERATORS)
    return "outside" if topic in outside else "nobody yet"


def consumers_of(topic: t.Topic) -> list[tuple[str, str]]:
    """Name and policy of each consumer."""
    if topic is t.CONTROL:
        return [("the service", "one at a time")]
    return [
        (box.name, str(port.policy)) for box in GRAPH for port in box.inputs if port.topic is topic
    ]


def topics_table() -> str:
    """Markdown: who makes each topic, and who takes it with which policy."""
    lines = ["| topic | says | made by | taken by |", "|---|---|---|---|"]
    for topic in t.TOPICS:
        name = "health/<actor>" if topic is t.HEALTH else topic.name
        state = " *" if topic.is_state else ""
        planned = "" if topic.message else " (declared)"
        takers = ", ".join(f"{who} {policy}" for who, policy in consumers_of(topic)) or "outside"
        lines.append(
            f"| `{name}`{state}{planned} | {topic.says} | {producer_of(topic)} | {takers} |"
        )
    return "\n".join(lines)


def drawing(boxes: Iterable[Box] = GRAPH) -> str:
    """The graph in Mermaid: solid arrows are lossless, dashed ones keep the latest."""
    lines = ["flowchart LR", "    camera([camera])", "    odometry([other odometry])"]
    boxes = tuple(boxes)
    for box in boxes:
        lines.append(f"    {box.name}{'' if box.make else ':::declared'}")
    for box in boxes:
        for port in box.inputs:
            arrow = "-->" if isinstance(port.policy, Lossless) else "-.->"
            for maker in _makers(port.topic, boxes):
                lines.append(f"    {maker} {arrow}|{port.topic.name}| {box.name}")
    lines.append("    classDef declared stroke-dasharray: 4 4")
    return "\n".join(lines)


def _makers(topic: t.Topic, boxes: tuple[Box, ...]) -> list[str]:
    makers = [box.name for box in boxes if any(out.topic is topic for out in box.outputs)]
    if topic in t.FROM_ODOMETRY:
        return ["odometry"]
    return makers or (["camera"] if topic in t.FROM_OUTSIDE else [])
