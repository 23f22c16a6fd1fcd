"""Names of regions that the detector does not know.                     actors/vlm_labeller.py

in   label/request   LabelRequest   Latest(1 per region)   a newer look at a region says more
in   label/add       AddLabel       Latest(32)             asked by a person, now and then, who
                                                           waits: it goes first
out  label/result    LabelResult    one for every request, late by design
out  label/names     LabelNames     one for every label/add

One region at a time, however long that takes: nobody waits for it. A labeller that cannot be used,
does not answer or talks nonsense never ends the service: regions stay unnamed, and health says so.
Without one every request is answered at once with no opinion.

A labeller behind a server asks what no journal has. A replay leaves such an actor out, and feeds
the mapper what it took when it was recorded.
"""

import logging
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from ldo_service.conversions.frames import crops_from_request
from ldo_service.detection.labellers import Labeller, Opinion
from ldo_service.detection.labellers.chat_completion import HttpConfig, HttpLabeller
from ldo_service.detection.labellers.dual_encoder import DualEncoderConfig
from ldo_service.detection.model_registry import open_labeller
from ldo_service.detection.vocabulary import read_names
from ldo_service.errors import ConfigError, EndpointError, FrameError, ModelError
from ldo_service.runtime import Actor, In, Latest, Out
from ldo_service.schemas import AddLabel, LabelNames, LabelRequest, LabelResult
from ldo_service.schemas.labels import MAX_ALTERNATIVES, MAX_NAMES
from ldo_service.schemas.topics import LABEL_ADD, LABEL_NAMES, LABEL_REQUEST, LABEL_RESULT
from ldo_service.storage.state_store import State

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class VlmLabellerConfig:
    model: str = ""  # a pair of encoders: a name of `ldo models list`, or a folder with its files
    url: str = ""  # of an OpenAI-compatible server, such as http://127.0.0.1:8000/v1
    names: str = ""  # file with a name a line to choose from; empty: those that come with the pair,
    # or the 80 of COCO; a server may answer any
    dual_encoder: DualEncoderConfig = field(default_factory=DualEncoderConfig)
    http: HttpConfig = field(default_factory=HttpConfig)

    def __post_init__(self) -> None:
        if self.model and self.url:
            raise ConfigError(
                f"vlm_labeller has model={self.model} and url={self.url}: choose one of them."
            )

    @property
    def is_chosen(self) -> bool:
        """One is named: the mapper asks for names then."""
        return bool(self.model or self.url)


class VlmLabeller(Actor):
    """Remembers the names that were added, and nothing else."""

    name = "vlm_labeller"
    inputs = (
        In(LABEL_REQUEST, Latest(1, per_key=True, max_keys=32)),
        In(LABEL_ADD, Latest(32), has_priority=True),
    )
    outputs = (Out(LABEL_RESULT), Out(LABEL_NAMES))

    def __init__(
        self, config: VlmLabellerConfig | None = None, labeller: Labeller | None = None
    ) -> None:
        """`labeller` in place of the one that the configuration names."""
        super().__init__()
        self.config = config or VlmLabellerConfig()
        self.talks_outside = bool(self.config.url)
        self._labeller = labeller
        self._state: State = {"added": ()}  # names, the same object until there is one more
        self._is_failing = False
        self._named = self._unnamed = self._failures = self._refusals = 0
        try:
            self._labeller = labeller or labeller_from_config(self.config)
        except ConfigError as error:
            log.error("no region is named: %s", error)

    def handle(self, message: LabelRequest | AddLabel) -> Iterator[LabelResult | LabelNames]:
        match message:
            case LabelRequest():
                yield self._answer(message)
            case AddLabel():
                yield self._add(message)

    def _answer(self, request: LabelRequest) -> LabelResult:
        opinions = self._label_region(request)
        (label, confidence), *others = opinions or [("", 0.0)]
        self._named += bool(label)
        self._unnamed += not label
        return LabelResult(
            stamp_ns=request.stamp_ns,
            region=request.region,
            keyframe=request.keyframe,
            label=label,
            confidence=min(confidence, 1.0) if label else 0.0,
            labeller=self._labeller.identity if self._labeller and opinions is not None else "",
            alternatives=tuple((name, min(sure, 1.0)) for name, sure in others[:MAX_ALTERNATIVES]),
        )

    def _label_region(self, request: LabelRequest) -> list[Opinion] | None:
        """None when nobody could look, which is logged once until somebody can again."""
        if self._labeller is None:
            return None
        try:
            opinions = self._labeller.label(crops_from_request(request))
        except (ModelError, EndpointError, FrameError) as error:
            if not self._is_failing:
                log.error("regions stay unnamed: %s: %s", self._labeller.identity, error)
            self._is_failing = True
            self._failures += 1
            return None
        if self._is_failing:
            log.info("regions are named again by %s", self._labeller.identity)
        self._is_failing = False
        return opinions

    def _add(self, message: AddLabel) -> LabelNames:
        refused = self._try_to_add(message.name)
        if refused:
            self._refusals += 1
            log.error("%r is not added: %s", message.name, refused)
        else:
            log.info("%r is added to the names", message.name)
            self._state = {"added": tuple(dict.fromkeys((*self._state["added"], message.name)))}
        names = self._labeller.names[:MAX_NAMES] if self._labeller else ()
        return LabelNames(stamp_ns=message.stamp_ns, names=names, error=refused)

    def _try_to_add(self, name: str) -> str:
        """Why not; empty when it is done."""
        if self._labeller is None:
            return "there is no labeller: set vlm_labeller.model or vlm_labeller.url."
        if len(self._labeller.names) >= MAX_NAMES:
            return f"there are {MAX_NAMES} names already."
        try:
            self._labeller.add(name)
        except ConfigError as error:
            return str(error)
        return ""

    def snapshot(self) -> State:
        return self._state

    def restore(self, state: State) -> None:
        """A name that this labeller cannot place stays remembered: a later one may."""
        self._state = {"added": tuple(state["added"])}
        for name in self._state["added"]:
            if refused := self._try_to_add(name):
                log.error("%r, added before, is left out: %s", name, refused)

    def metrics(self) -> dict[str, float]:
        """`labellers_missing`: named in the configuration, and cannot be used."""
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
    """The labeller that a configuration names; None where it names none. Raises ConfigError."""
    if not config.is_chosen:
        return None
    names = read_names(Path(config.names).expanduser()) if config.names else ()
    if config.url:
        return HttpLabeller(config.url, config.http, names)
    return open_labeller(config.model, config.dual_encoder, names)


def require_labeller(config: VlmLabellerConfig) -> None:
    """Raises ConfigError when it cannot be used: a run over a file is asked for it, where a service
    rather goes on without. Whether a server answers is found out when it is asked."""
    labeller_from_config(config)
