"""Labels by a vision-language model behind an OpenAI-compatible server: vLLM, llama.cpp, Ollama.

An answer of the model must be a single name; any other answer is rejected. The confidence comes
from the log-probabilities of the answer's tokens.
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

from ldo_service.detection.labellers import ScoredLabel, fused_over_views
from ldo_service.detection.vocabulary import LONGEST, canonical, is_name
from ldo_service.errors import ConfigError, EndpointError, named
from ldo_service.geometry import codecs
from ldo_service.geometry.codecs import shrunk

from .http_endpoint import HttpClient, HttpClientConfig

log = logging.getLogger(__name__)

NONE = "none"  # Answer of the model if no name fits.
# Answers that name no object.
_NO_NAME = {NONE, "unknown", "unclear", "nothing", "object", "thing", "item", "n/a", "unsure"}
_NAME = re.compile(r"[^\W\d_][\w' -]*")  # Words, beginning with a letter.
_MARK = re.compile(r"<[|/]?\w+[|]?>")  # Special token of a model, such as an end of turn.

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
    """Answer of the model.

    Attributes:
        text: Text of the answer.
        logprobs: Log-probabilities of the tokens of `text`; empty if the server returns none.
    """

    text: str
    logprobs: tuple[float, ...] = ()


def read_answer(body: bytes) -> Answer:
    """Return the first choice of a chat completion, the response of OpenAI's API.

    Args:
        body: Body of the response, JSON.

    Raises:
        EndpointError: If the body is not a chat completion.
    """
    try:
        choice = msgspec.json.decode(body, type=_Completion).choices[0]
    except (msgspec.DecodeError, IndexError, RecursionError, UnicodeDecodeError) as error:
        raise EndpointError(
            f"the response {body[:60]!r} is not a chat completion: check that vlm_labeller.url is "
            "the address of an OpenAI-compatible server, with its path (often /v1)."
        ) from error
    return Answer((choice.message.content or "").strip(), _logprobs(choice.logprobs))


def confidence(logprobs: tuple[float, ...], how: Sureness) -> float:
    """Return the confidence of an answer: product or geometric mean of its tokens' probabilities.

    `product` is the probability of exactly this answer. It is lower for names of many tokens.
    `mean` does not depend on the number of tokens. It is too high for a name whose later tokens
    follow from the first one.

    >>> round(confidence((-0.1, -0.3), "product"), 3), round(confidence((-0.1, -0.3), "mean"), 3)
    (0.67, 0.819)
    """
    total = sum(logprobs) if how == "product" else sum(logprobs) / len(logprobs)
    return exp(min(total, 0.0))


def name_of(text: str, allowed: Collection[str], max_words: int) -> str | None:
    """Return the canonical name in an answer, or None if the answer is not one allowed name.

    Args:
        text: Answer of the model.
        allowed: Allowed canonical names; empty: any name.
        max_words: Maximum number of words in a name.

    >>> name_of("A Sofa.", (), 4), name_of("sofa", ("chair",), 4), name_of("I am not sure", (), 3)
    ('couch', None, None)
    """
    plain = _MARK.sub("", text).strip().strip("\"'`*.!").strip()
    plain = re.sub(r"^(?:an?|the)\s+", "", plain, flags=re.IGNORECASE)
    if len(plain) > 100 or len(plain.split()) > max_words or not _NAME.fullmatch(plain):
        return None
    name = canonical(plain)
    if allowed:
        return name if name in allowed else None
    return None if name in _NO_NAME else name


def _logprobs(raw: msgspec.Raw) -> tuple[float, ...]:
    """Return the log-probabilities of the answer's tokens, without white space and special tokens.

    The result is empty if the entry is missing or a value is not a valid log-probability.
    """
    try:
        response = msgspec.json.decode(raw, type=_Logprobs | None)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError):
        return ()
    tokens = (response.content or []) if response else []
    spelling = [t for t in tokens if t.token.strip() and not _MARK.fullmatch(t.token.strip())]
    are_usable = all(isfinite(token.logprob) and token.logprob <= 1e-3 for token in spelling)
    return tuple(token.logprob for token in spelling) if are_usable else ()


@dataclass(frozen=True, slots=True)
class HttpConfig:
    """Settings of the requests to a vision-language model.

    A request shows one view of a region: a crop of the color image of a keyframe around the region.
    """

    model: str = ""  # Name of the model on the server; empty: the server's only model.
    views: int = 2  # Maximum views of a region that are sent, in one request each.
    # Maximum side of a crop; a larger one is scaled down. 336 px is the input of CLIP-L, the image
    # encoder of LLaVA.
    side_px: int = 336
    # Confidence of an answer: the product of its tokens' probabilities, or their geometric mean.
    confidence: Sureness = "product"
    confidence_untold: float = 0.3  # Confidence if the server returns no log-probabilities.
    max_words: int = 4  # Maximum words of a name; a longer answer is rejected as a sentence.
    max_tokens: int = 16  # Maximum tokens of an answer.
    endpoint: HttpClientConfig = field(default_factory=HttpClientConfig)

    def __post_init__(self) -> None:
        if self.confidence not in ("product", "mean"):
            raise ConfigError(named(self, "confidence") + " must be 'product' or 'mean'.")
        if min(self.views, self.side_px, self.max_words, self.max_tokens) < 1:
            raise ConfigError(
                named(self, "views", "side_px", "max_words", "max_tokens") + " must be at least 1."
            )
        if not 0 <= self.confidence_untold <= 1:
            raise ConfigError(named(self, "confidence_untold") + " must be in [0, 1].")


class HttpLabeller:
    """Labeller by a vision-language model on a server, with one request per view of a region.

    The labels of the views are fused by `fused_over_views`. A view with an invalid answer has no
    label.
    """

    def __init__(
        self,
        url: str,
        config: HttpConfig | None = None,
        names: Sequence[str] = (),
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """Create a labeller; no request is sent.

        Args:
            url: Address of the API, such as http://127.0.0.1:8000/v1.
            config: Settings.
            names: Names that the model must choose from; empty: it may answer any name.
            clock: See `HttpClient`.
            sleep: See `HttpClient`.

        Raises:
            ConfigError: If the address or the key is invalid.
        """
        self.config = config or HttpConfig()
        self._endpoint, self._clock = HttpClient(url, self.config.endpoint, clock, sleep), clock
        self._names = list(dict.fromkeys(map(canonical, names)))
        self._questions = self._refused = self._undecided = self._untold = 0
        self.identity = f"{self.config.model or 'model'} at {url}"

    @property
    def names(self) -> tuple[str, ...]:
        """Canonical names that the model must choose from; empty: it may answer any name."""
        return tuple(self._names)

    def add(self, name: str) -> None:
        """Add a name to the list that the model chooses from.

        Raises:
            ConfigError: If the name is invalid, or the labeller has no list of names.
        """
        if not is_name(name):
            raise ConfigError(
                f"{name[:40]!r} is not a name: write a name of 1 to {LONGEST} characters."
            )
        if not self._names:
            raise ConfigError(
                f"the name {name!r} cannot be added: the labeller {self.identity} has no list of "
                "names, so it can already answer with any name. Set vlm_labeller.class_names to "
                "let it choose from a list."
            )
        if canonical(name) not in self._names:
            self._names.append(canonical(name))

    def label(self, crops: Sequence[np.ndarray]) -> list[ScoredLabel]:
        """Return the labels of a region; see `Labeller`.

        A view with a rejected answer has no label. If the server fails after some views have
        labels, these labels are used. All views together have the time limit
        `HttpClientConfig.patience_s`. Once the remaining time is shorter than the slowest view
        took, the remaining views are omitted.
        """
        views: list[list[ScoredLabel]] = []
        until_s, slowest_s = self._clock() + self.config.endpoint.patience_s, 0.0
        for crop in crops[: self.config.views]:
            start_s = self._clock()
            if start_s + slowest_s > until_s:
                break
            try:
                views.append(self._label_crop(crop, until_s))
            except EndpointError:
                if not any(views):
                    raise
                break
            slowest_s = max(slowest_s, self._clock() - start_s)
        return fused_over_views(views)

    def metrics(self) -> dict[str, float]:
        """Return the counters of the labeller.

        `answers_refused` counts answers that are not a valid name or not in the list of names.
        `answers_none` counts the answer "none", which means that the model cannot recognize the
        object. `answers_without_logprobs` counts answers without log-probabilities; they have the
        confidence `HttpConfig.confidence_untold`.
        """
        return {
            "names": len(self._names),
            "questions": self._questions,
            "attempts": self._endpoint.attempts,
            "answers_refused": self._refused,
            "answers_none": self._undecided,
            "answers_without_logprobs": self._untold,
        }

    def _label_crop(self, crop: np.ndarray, until_s: float) -> list[ScoredLabel]:
        """Request the label of one view; the result is empty if the answer is rejected."""
        self._questions += 1
        body = self._endpoint.post("/chat/completions", self._question(crop), until_s)
        answer = read_answer(body)
        name = name_of(answer.text, self.names, self.config.max_words)
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
                "labeller: %s returns no log-probabilities; its answers have the confidence %g. To "
                "change it, set vlm_labeller.http.default_confidence; otherwise no action needed.",
                self.identity,
                self.config.confidence_untold,
            )
        self._untold += 1
        return self.config.confidence_untold

    def _question(self, crop: np.ndarray) -> bytes:
        """Return the JSON of a request of OpenAI's API: the prompt, then the crop as a data URL."""
        picture = base64.b64encode(codecs.encode_jpeg(shrunk(crop, self.config.side_px))).decode()
        text = CLOSED_PROMPT.format(names=", ".join(self._names)) if self._names else OPEN_PROMPT
        content = [
            {"type": "text", "text": text},
            {"type": "image_url", "image_url": {"url": f"data:image/jpeg;base64,{picture}"}},
        ]
        question = {
            "messages": [{"role": "user", "content": content}],
            "temperature": 0,
            "max_tokens": self.config.max_tokens,
            "logprobs": True,
            **({"model": self.config.model} if self.config.model else {}),
        }
        return msgspec.json.encode(question)
