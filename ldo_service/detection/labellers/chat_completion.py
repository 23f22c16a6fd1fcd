"""Labels by a vision-language model behind an OpenAI-compatible server: vLLM, llama.cpp, Ollama.

The model's answer is read as one name and a confidence; anything else is refused.
"""

import base64
import logging
import re
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from math import exp, isfinite
from typing import Literal

import msgspec
import numpy as np

from ldo_service.detection.labellers import Opinion, fused_over_views
from ldo_service.detection.vocabulary import LONGEST, canonical, is_name
from ldo_service.errors import ConfigError, EndpointError
from ldo_service.geometry import codecs
from ldo_service.geometry.codecs import shrunk

from .http_endpoint import HttpClient, HttpClientConfig

log = logging.getLogger(__name__)

NONE = "none"  # what a model is told to say when no name fits
_NO_NAME = {NONE, "unknown", "unclear", "nothing", "object", "thing", "item", "n/a", "unsure"}
_NAME = re.compile(r"[^\W\d_][\w' -]*")  # of words, beginning with a letter
_MARK = re.compile(r"<[|/]?\w+[|]?>")  # of a model's own, such as an end of turn

OPEN_PROMPT = (
    "What is the object in the middle of this picture? Answer with its common name alone, in one "
    f'to three words, in English, without a sentence. If you cannot tell, answer "{NONE}".'
)
CLOSED_PROMPT = (
    "Which of these is the object in the middle of this picture? {names}. Answer with one of these "
    f'names alone, as it is written here. If none of them fits, answer "{NONE}".'
)


Sureness = Literal["product", "mean"]


class _Token(msgspec.Struct):
    token: str
    logprob: float


class _Logprobs(msgspec.Struct):
    content: list[_Token] | None = None


class _Message(msgspec.Struct):
    content: str | None = None


class _Choice(msgspec.Struct):
    message: _Message
    logprobs: msgspec.Raw = msgspec.Raw(b"null")


class _Completion(msgspec.Struct):
    choices: list[_Choice]


@dataclass(frozen=True, slots=True)
class Answer:
    """`logprobs` of the tokens that spell `text`; empty where the server tells none."""

    text: str
    logprobs: tuple[float, ...] = ()


def read_answer(body: bytes) -> Answer:
    """The first choice of a chat completion, as OpenAI's API has it. Raises EndpointError."""
    try:
        choice = msgspec.json.decode(body, type=_Completion).choices[0]
    except (msgspec.DecodeError, IndexError, RecursionError, UnicodeDecodeError) as error:
        raise EndpointError(
            f"it answers {body[:60]!r}, which is no chat completion: is this the address of an "
            "OpenAI-compatible server, with its path (often /v1)?"
        ) from error
    return Answer((choice.message.content or "").strip(), _logprobs(choice.logprobs))


def confidence(logprobs: tuple[float, ...], how: Sureness) -> float:
    """How probable the answer was: the product over its tokens, or their geometric mean.

    `product` is the probability of just this answer, so a name of many tokens is less sure; `mean`
    takes length out and overstates names whose first token says it all.

    >>> round(confidence((-0.1, -0.3), "product"), 3), round(confidence((-0.1, -0.3), "mean"), 3)
    (0.67, 0.819)
    """
    total = sum(logprobs) if how == "product" else sum(logprobs) / len(logprobs)
    return exp(min(total, 0.0))


def name_of(text: str, allowed: Collection[str], most_words: int) -> str | None:
    """The name in an answer as a vocabulary has it; None for what is none, or not `allowed`.

    allowed  names as a vocabulary has them; empty: any of at most `most_words` words

    >>> name_of("A Sofa.", (), 4), name_of("sofa", ("chair",), 4), name_of("I am not sure", (), 3)
    ('couch', None, None)
    """
    plain = _MARK.sub("", text).strip().strip("\"'`*.!").strip()
    plain = re.sub(r"^(?:an?|the)\s+", "", plain, flags=re.IGNORECASE)
    if len(plain) > 100 or len(plain.split()) > most_words or not _NAME.fullmatch(plain):
        return None
    name = canonical(plain)
    if allowed:
        return name if name in allowed else None
    return None if name in _NO_NAME else name


def _logprobs(raw: msgspec.Raw) -> tuple[float, ...]:
    """Those of tokens that are not white or a mark; empty unless all of them are numbers."""
    try:
        told = msgspec.json.decode(raw, type=_Logprobs | None)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError):
        return ()
    tokens = (told.content or []) if told else []
    spelling = [t for t in tokens if t.token.strip() and not _MARK.fullmatch(t.token.strip())]
    are_usable = all(isfinite(token.logprob) and token.logprob <= 1e-3 for token in spelling)
    return tuple(token.logprob for token in spelling) if are_usable else ()


@dataclass(frozen=True, slots=True)
class HttpConfig:
    """How a vision-language model is asked."""

    model: str = ""  # its name on the server; empty: the server's only one
    views: int = 2  # of a region at most, each a question of its own
    side_px: int = 336  # a larger crop is shrunk to it: what CLIP-L at 336 px, LLaVA's eye, sees
    confidence: Sureness = "product"  # of an answer's tokens: the probability of all, or their mean
    confidence_untold: float = 0.3  # where the server tells no log-probabilities
    most_words: int = 4  # of an answer to the open question; more is a sentence
    most_tokens: int = 16  # asked for
    endpoint: HttpClientConfig = field(default_factory=HttpClientConfig)

    def __post_init__(self) -> None:
        if self.confidence not in ("product", "mean"):
            raise ConfigError(f"http.confidence={self.confidence!r} must be 'product' or 'mean'.")
        if min(self.views, self.side_px, self.most_words, self.most_tokens) < 1:
            raise ConfigError(
                "http: views, side_px, most_words and most_tokens must be at least 1."
            )
        if not 0 <= self.confidence_untold <= 1:
            raise ConfigError("http.confidence_untold must be within 0..1.")


class HttpLabeller:
    """Asks for one view at a time; the answers are fused. Keeps to itself what it does not trust.

    url    of the API, such as http://127.0.0.1:8000/v1
    names  to choose from; empty: the question is open
    clock, sleep  see `HttpClient`

    Raises ConfigError for an address or a key that cannot be.
    """

    def __init__(
        self,
        url: str,
        config: HttpConfig | None = None,
        names: Sequence[str] = (),
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.config = config or HttpConfig()
        self._endpoint, self._clock = HttpClient(url, self.config.endpoint, clock, sleep), clock
        self._names = list(dict.fromkeys(map(canonical, names)))
        self._questions = self._refused = self._undecided = self._untold = 0
        self.identity = f"{self.config.model or 'model'} at {url}"

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self._names)

    def add(self, name: str) -> None:
        """Raises ConfigError when it may say any name, or for what is none."""
        if not is_name(name):
            raise ConfigError(f"{name[:40]!r} is no name: write one of 1 to {LONGEST} characters.")
        if not self._names:
            raise ConfigError(
                f"{self.identity} may answer any name, {name!r} too: a list that one could add to "
                "is given with vlm_labeller.class_names."
            )
        if canonical(name) not in self._names:
            self._names.append(canonical(name))

    def label(self, crops: Sequence[np.ndarray]) -> list[Opinion]:
        """See `Labeller`. A view whose answer is refused has no opinion; when the server fails
        after a view was answered, that view's answer stands alone. All of them have `patience_s`
        together: one that would take longer than is left, going by those before, is left out."""
        views: list[list[Opinion]] = []
        until_s, slowest_s = self._clock() + self.config.endpoint.patience_s, 0.0
        for crop in crops[: self.config.views]:
            start_s = self._clock()
            if start_s + slowest_s > until_s:
                break
            try:
                views.append(self._look(crop, until_s))
            except EndpointError:
                if not any(views):
                    raise
                break
            slowest_s = max(slowest_s, self._clock() - start_s)
        return fused_over_views(views)

    def metrics(self) -> dict[str, float]:
        """`answers_refused`: no name, or none of the list. `answers_none`: the model said that
        it cannot tell. `answers_without_logprobs`: sure to a configured degree only."""
        return {
            "names": len(self._names),
            "questions": self._questions,
            "attempts": self._endpoint.attempts,
            "answers_refused": self._refused,
            "answers_none": self._undecided,
            "answers_without_logprobs": self._untold,
        }

    def _look(self, crop: np.ndarray, until_s: float) -> list[Opinion]:
        self._questions += 1
        body = self._endpoint.post("/chat/completions", self._question(crop), until_s)
        answer = read_answer(body)
        name = name_of(answer.text, self.names, self.config.most_words)
        if name is None:
            self._undecided += canonical(answer.text.strip(" .\"'")) == NONE
            self._refused += canonical(answer.text.strip(" .\"'")) != NONE
            return []
        return [(name, self._confidence(answer))]

    def _confidence(self, answer: Answer) -> float:
        if answer.logprobs:
            return confidence(answer.logprobs, self.config.confidence)
        if not self._untold:
            log.warning(
                "%s tells no log-probabilities: its answers count as %g sure",
                self.identity,
                self.config.confidence_untold,
            )
        self._untold += 1
        return self.config.confidence_untold

    def _question(self, crop: np.ndarray) -> bytes:
        """As OpenAI's API has it: text, then the picture in the address of a data URL."""
        picture = base64.b64encode(codecs.encode_jpeg(shrunk(crop, self.config.side_px))).decode()
        text = CLOSED_PROMPT.format(names=", ".join(self._names)) if self._names else OPEN_PROMPT
        content = [
            {"type": "text", "text": text},
            {"type": "image_url", "image_url": {"url": f"data:image/jpeg;base64,{picture}"}},
        ]
        question = {
            "messages": [{"role": "user", "content": content}],
            "temperature": 0,
            "max_tokens": self.config.most_tokens,
            "logprobs": True,
            **({"model": self.config.model} if self.config.model else {}),
        }
        return msgspec.json.encode(question)
