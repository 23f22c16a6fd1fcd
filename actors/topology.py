"""Graph of actors: every actor with its ports and its factory.

The diagram and the topic table of the documentation are generated from `GRAPH`. The command
`ldo topics --mermaid` prints the diagram, and `ldo topics --markdown` prints the table.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

from ldo_service.actors.detector import Detector, DetectorConfig
from ldo_service.actors.frame_source import FrameSource, FrameSourceConfig
from ldo_service.actors.loop_closer import LoopCloser, LoopCloserConfig
from ldo_service.actors.mapper import Mapper
from ldo_service.actors.mapper_config import MapperConfig
from ldo_service.actors.optimizer import Optimizer, OptimizerConfig
from ldo_service.actors.tracker import Tracker, TrackerConfig
from ldo_service.actors.vlm_labeller import VlmLabeller, VlmLabellerConfig
from ldo_service.errors import ConfigError
from ldo_service.runtime import Actor, In, Lossless, Out
from ldo_service.schemas import topics as t


@dataclass(frozen=True, slots=True)
class ActorParameters:
    """Parameter objects of all actors; the defaults are those of the configuration."""

    frame_source: FrameSourceConfig = field(default_factory=FrameSourceConfig)
    tracker: TrackerConfig = field(default_factory=TrackerConfig)
    detector: DetectorConfig = field(default_factory=DetectorConfig)
    vlm_labeller: VlmLabellerConfig = field(default_factory=VlmLabellerConfig)
    mapper: MapperConfig = field(default_factory=MapperConfig)
    loop_closer: LoopCloserConfig = field(default_factory=LoopCloserConfig)
    optimizer: OptimizerConfig = field(default_factory=OptimizerConfig)


@dataclass(frozen=True, slots=True)
class ActorSpec:
    """Name, ports and factory of an actor."""

    name: str
    inputs: tuple[In, ...]
    outputs: tuple[Out, ...]
    is_backend: bool  # True if no other actor waits for its outputs.
    make: Callable[[ActorParameters], Actor]


def _box(actor: type[Actor], make: Callable[[ActorParameters], Actor]) -> ActorSpec:
    return ActorSpec(actor.name, actor.inputs, actor.outputs, actor.is_backend, make)


GRAPH: tuple[ActorSpec, ...] = (
    _box(FrameSource, lambda parameters: FrameSource(parameters.frame_source)),
    _box(Tracker, lambda parameters: Tracker(parameters.tracker)),
    _box(Detector, lambda parameters: Detector(parameters.detector)),
    _box(VlmLabeller, lambda parameters: VlmLabeller(parameters.vlm_labeller)),
    _box(
        Mapper,
        lambda parameters: Mapper(
            parameters.mapper, has_labeller=parameters.vlm_labeller.is_chosen
        ),
    ),
    _box(LoopCloser, lambda parameters: LoopCloser(parameters.loop_closer)),
    _box(Optimizer, lambda parameters: Optimizer(parameters.optimizer)),
)


def actor_spec(name: str) -> ActorSpec:
    """Return the specification of an actor by its name.

    Raises:
        ConfigError: There is no such actor.
    """
    for box in GRAPH:
        if box.name == name:
            return box
    names = ", ".join(box.name for box in GRAPH)
    raise ConfigError(f"there is no actor {name!r}. Choose one of {names}.")


def make_actors(parameters: ActorParameters) -> list[Actor]:
    """Return new instances of all actors, producers first."""
    return [box.make(parameters) for box in GRAPH]


def producer_of(topic: t.Topic) -> str:
    """Return the name of the actor that publishes a topic.

    The result is `outside` if other programs publish it, `every actor` if each actor does, and
    `none` if it has no producer.
    """
    for box in GRAPH:
        if any(out.topic is topic for out in box.outputs):
            return box.name
    if topic is t.HEALTH:
        return "every actor"
    if topic is t.CONTROL:
        return "outside"
    outside = (*t.FROM_OUTSIDE, *t.FROM_ODOMETRY, *t.FROM_OPERATORS)
    return "outside" if topic in outside else "none"


def consumers_of(topic: t.Topic) -> list[tuple[str, str]]:
    """Return the name and the delivery policy of each consumer of a topic."""
    if topic is t.CONTROL:
        return [("the service", "(one request at a time)")]
    return [
        (box.name, str(port.policy)) for box in GRAPH for port in box.inputs if port.topic is topic
    ]


def topics_table() -> str:
    """Return a Markdown table of all topics with their producers, consumers and policies."""
    lines = ["| topic | content | producer | consumers |", "|---|---|---|---|"]
    for topic in t.TOPICS:
        name = f"{topic.name}/<actor>" if topic.is_per_actor else topic.name
        state = " *" if topic.is_state else ""
        takers = ", ".join(f"{who} {policy}" for who, policy in consumers_of(topic)) or "outside"
        lines.append(f"| `{name}`{state} | {topic.description} | {producer_of(topic)} | {takers} |")
    return "\n".join(lines)


def mermaid_diagram(boxes: Iterable[ActorSpec] = GRAPH) -> str:
    """Return the graph in Mermaid, with solid arrows for the policies Lossless and Backlog."""
    lines = ["flowchart LR", "    camera([camera])", "    odometry([other odometry])"]
    boxes = tuple(boxes)
    lines.extend(f"    {box.name}" for box in boxes)
    for box in boxes:
        for port in box.inputs:
            arrow = "-->" if isinstance(port.policy, Lossless) else "-.->"
            lines.extend(
                f"    {maker} {arrow}|{port.topic.name}| {box.name}"
                for maker in _makers(port.topic, boxes)
            )
    return "\n".join(lines)


def _makers(topic: t.Topic, boxes: tuple[ActorSpec, ...]) -> list[str]:
    makers = [box.name for box in boxes if any(out.topic is topic for out in box.outputs)]
    if topic in t.FROM_ODOMETRY:
        return ["odometry"]
    return makers or (["camera"] if topic in t.FROM_OUTSIDE else [])
