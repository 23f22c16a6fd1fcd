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


def _spec(actor: type[Actor], make: Callable[[ActorParameters], Actor]) -> ActorSpec:
    return ActorSpec(actor.name, actor.inputs, actor.outputs, actor.is_backend, make)


GRAPH: tuple[ActorSpec, ...] = (
    _spec(FrameSource, lambda parameters: FrameSource(parameters.frame_source)),
    _spec(Tracker, lambda parameters: Tracker(parameters.tracker)),
    _spec(Detector, lambda parameters: Detector(parameters.detector)),
    _spec(VlmLabeller, lambda parameters: VlmLabeller(parameters.vlm_labeller)),
    _spec(
        Mapper,
        lambda parameters: Mapper(
            parameters.mapper, has_labeller=parameters.vlm_labeller.is_chosen
        ),
    ),
    _spec(LoopCloser, lambda parameters: LoopCloser(parameters.loop_closer)),
    _spec(Optimizer, lambda parameters: Optimizer(parameters.optimizer)),
)


def actor_spec(name: str) -> ActorSpec:
    """Return the specification of an actor by its name.

    Raises:
        ConfigError: There is no such actor.
    """
    for spec in GRAPH:
        if spec.name == name:
            return spec
    names = ", ".join(spec.name for spec in GRAPH)
    raise ConfigError(f"there is no actor {name!r}. Choose one of {names}.")


def make_actors(parameters: ActorParameters) -> list[Actor]:
    """Return new instances of all actors, producers first."""
    return [spec.make(parameters) for spec in GRAPH]


def producer_of(topic: t.Topic) -> str:
    """Return the name of the actor that publishes a topic.

    The result is `outside` if other programs publish it, `every actor` if each actor does, and
    `none` if it has no producer.
    """
    for spec in GRAPH:
        if any(out.topic is topic for out in spec.outputs):
            return spec.name
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
        (spec.name, str(port.policy))
        for spec in GRAPH
        for port in spec.inputs
        if port.topic is topic
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


def mermaid_diagram(specs: Iterable[ActorSpec] = GRAPH) -> str:
    """Return the graph in Mermaid, with solid arrows for the policies Lossless and Backlog."""
    lines = ["flowchart LR", "    camera([camera])", "    odometry([other odometry])"]
    specs = tuple(specs)
    lines.extend(f"    {spec.name}" for spec in specs)
    for spec in specs:
        for port in spec.inputs:
            arrow = "-->" if isinstance(port.policy, Lossless) else "-.->"
            lines.extend(
                f"    {maker} {arrow}|{port.topic.name}| {spec.name}"
                for maker in _makers(port.topic, specs)
            )
    return "\n".join(lines)


def _makers(topic: t.Topic, specs: tuple[ActorSpec, ...]) -> list[str]:
    makers = [spec.name for spec in specs if any(out.topic is topic for out in spec.outputs)]
    if topic in t.FROM_ODOMETRY:
        return ["odometry"]
    return makers or (["camera"] if topic in t.FROM_OUTSIDE else [])
