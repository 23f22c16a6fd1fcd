"""Labelling of regions that the detector does not know.

Topics, their messages, the delivery policy of each input (with its queue length), and notes:

in   label/request   LabelRequest   Backlog(2)             one request waits, one is labelled
in   label/add       AddLabel       Latest(32)             has priority, because a user waits
out  label/result    LabelResult                           one for every request, often late
out  label/names     LabelNames                            one for every label/add

The actor labels one region at a time. No other actor waits for it, however long a request takes.
The service continues if the labeller fails or returns invalid answers. Regions then stay without a
label, and the metrics report the failure. If no labeller is configured, the actor answers every
request immediately with an empty label.

The answers of a labelling server are not reproducible from a journal. A replay therefore skips this
actor and feeds the recorded results to the mapper.
"""

import logging
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from ldo_service.conversions.frames import crops_from_request
from ldo_service.detection.labellers import Labeller, ScoredLabel
from ldo_service.detection.labellers.chat_completion import HttpConfig, HttpLabeller
from ldo_service.detection.labellers.dual_encoder import DualEncoderConfig
from ldo_service.detection.open_networks import open_labeller
from ldo_service.detection.vocabulary import canonical, read_names
from ldo_service.errors import ConfigError, EndpointError, FrameError, ModelError
from ldo_service.runtime import Actor, Backlog, In, Latest, Out
from ldo_service.schemas import AddLabel, LabelNames, LabelRequest, LabelResult
from ldo_service.schemas.labels import MAX_ALTERNATIVES, MAX_NAMES
from ldo_service.schemas.topics import LABEL_ADD, LABEL_NAMES, LABEL_REQUEST, LABEL_RESULT
from ldo_service.storage.state_store import State

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class VlmLabellerConfig:
    """Choice and parameters of the labeller."""

    model: str = ""  # Dual encoder: a name of `ldo models list`, or a folder; empty: none.
    url: str = ""  # OpenAI-compatible server, such as http://127.0.0.1:8000/v1; empty: none.
    # File with the names to choose from, one per line. Empty: a dual encoder uses its own names, or
    # the 80 classes of COCO if it has none; a server may return any name.
    names: str = ""
    dual_encoder: DualEncoderConfig = field(default_factory=DualEncoderConfig)
    http: HttpConfig = field(default_factory=HttpConfig)

    def __post_init__(self) -> None:
        if self.model and self.url:
            raise ConfigError(
                f"vlm_labeller.model={self.model} and vlm_labeller.url={self.url} exclude each "
                "other; choose one of them."
            )

    @property
    def is_chosen(self) -> bool:
        """True if a labeller is configured; the mapper then sends label requests."""
        return bool(self.model or self.url)


class VlmLabeller(Actor):
    """Actor that labels regions; its only state is the tuple of added names."""

    name = "vlm_labeller"
    inputs = (
        In(LABEL_REQUEST, Backlog(2)),
        In(LABEL_ADD, Latest(32), has_priority=True),
    )
    outputs = (Out(LABEL_RESULT), Out(LABEL_NAMES))
    is_backend = True

    def __init__(
        self, config: VlmLabellerConfig | None = None, labeller: Labeller | None = None
    ) -> None:
        """Open the configured labeller, or use `labeller` instead if it is not None."""
        super().__init__()
        self.config = config or VlmLabellerConfig()
        self.talks_outside = bool(self.config.url)
        self._labeller = labeller
        # Added names; the same object until the next name is added.
        self._state: State = {"added": ()}
        self._is_failing = False
        self._named = self._unnamed = self._failures = self._refusals = 0
        try:
            self._labeller = labeller or labeller_from_config(self.config)
        except ConfigError as error:
            log.error("vlm_labeller disabled: %s Regions get no open-vocabulary label.", error)

    def handle(self, message: LabelRequest | AddLabel) -> Iterator[LabelResult | LabelNames]:
        """Yield the label of a requested region, or all known names after adding a name."""
        match message:
            case LabelRequest():
                yield self._answer(message)
            case AddLabel():
                yield self._add(message)

    def _answer(self, request: LabelRequest) -> LabelResult:
        scored_labels = self._label_region(request)
        (label, confidence), *others = scored_labels or [("", 0.0)]
        self._named += bool(label)
        self._unnamed += not label
        return LabelResult(
            stamp_ns=request.stamp_ns,
            region=request.region,
            keyframe=request.keyframe,
            label=label,
            confidence=min(confidence, 1.0) if label else 0.0,
            labeller=self._labeller.identity
            if self._labeller and scored_labels is not None
            else "",
            alternatives=tuple((name, min(sure, 1.0)) for name, sure in others[:MAX_ALTERNATIVES]),
        )

    def _label_region(self, request: LabelRequest) -> list[ScoredLabel] | None:
        """Return the labels of a region, the most likely first, or None if no labeller answered.

        The first failure is logged; further ones are logged only after a success.
        """
        if self._labeller is None:
            return None
        try:
            scored_labels = self._labeller.label(crops_from_request(request))
        except (ModelError, EndpointError, FrameError) as error:
            if not self._is_failing:
                log.error(
                    "vlm_labeller: the labeller %s failed: %s Regions get no open-vocabulary label "
                    "until the labeller succeeds.",
                    self._labeller.identity,
                    error,
                )
            self._is_failing = True
            self._failures += 1
            return None
        if self._is_failing:
            log.info("vlm_labeller: %s labels regions again", self._labeller.identity)
        self._is_failing = False
        return scored_labels

    def _add(self, message: AddLabel) -> LabelNames:
        refused = self._try_to_add(message.name)
        if refused:
            self._refusals += 1
            log.error("vlm_labeller: name %r not added: %s", message.name, refused)
        else:
            log.info("vlm_labeller: name %r added", message.name)
            added = self._state["added"]
            if canonical(message.name) not in map(canonical, added):
                self._state = {"added": (*added, message.name)}
        names = self._labeller.names[:MAX_NAMES] if self._labeller else ()
        return LabelNames(stamp_ns=message.stamp_ns, names=names, error=refused)

    def _try_to_add(self, name: str) -> str:
        """Add a name; return an empty string, or the reason if the name is rejected."""
        if self._labeller is None:
            return "there is no labeller: set vlm_labeller.model or vlm_labeller.url."
        if len(self._labeller.names) >= MAX_NAMES:
            return f"there are {MAX_NAMES} names already, the maximum."
        try:
            self._labeller.add(name)
        except ConfigError as error:
            return str(error)
        return ""

    def snapshot(self) -> State:
        """Return the added names."""
        return self._state

    def restore(self, state: State) -> None:
        """Add the saved names again.

        A name that this labeller rejects stays saved, because another labeller may accept it.
        """
        self._state = {"added": tuple(state["added"])}
        for name in self._state["added"]:
            if refused := self._try_to_add(name):
                log.error("vlm_labeller: saved name %r not added: %s", name, refused)

    def metrics(self) -> dict[str, float]:
        """Return counters; `labellers_missing` is 1 if the configured labeller cannot be used."""
        return {
            "labellers": float(self._labeller is not None),
            "labellers_missing": float(self.config.is_chosen and self._labeller is None),
            "labellings_failed": self._failures,
            "labeller_failing": float(self._is_failing),
            "regions_named": self._named,
            "regions_unnamed": self._unnamed,
            "names_added": len(self._state["added"]),
            "names_refused": self._refusals,
            **(self._labeller.metrics() if self._labeller else {}),
        }


def labeller_from_config(config: VlmLabellerConfig) -> Labeller | None:
    """Return the configured labeller, or None if none is configured.

    Raises:
        ConfigError: The labeller or its names cannot be used.
    """
    if not config.is_chosen:
        return None
    names = read_names(Path(config.names).expanduser()) if config.names else ()
    if config.url:
        return HttpLabeller(config.url, config.http, names)
    return open_labeller(config.model, config.dual_encoder, names)


def require_labeller(config: VlmLabellerConfig) -> None:
    """Check that the configured labeller can be used.

    This function does not contact the server of a labeller; the first label request does. If the
    labeller cannot be used, an offline run does not start. A live service starts without a labeller
    instead.

    Raises:
        ConfigError: The labeller cannot be used.
    """
    labeller_from_config(config)
