"""What a chat model says, read as one name and how sure it is; what is none is refused."""

import re
from collections.abc import Collection
from dataclasses import dataclass
from math import exp, isfinite
from typing import Literal

import msgspec

from ldo_service.errors import EndpointError
from ldo_service.semantics.synonyms import canonical

NONE = "none"  # what a model is told to say when no name fits
_NO_NAME = {NONE, "unknown", "unclear", "nothing", "object", "thing", "item", "n/a", "unsure"}
_NAME = re.compile(r"[^\W\d_][\w' -]*")  # of words, beginning with a letter
_MARK = re.compile(r"<[|/]?\w+[|]?>")  # of a model's own, such as an end of turn

Sureness = Literal["product", "mean"]


class _Token(msgspec.Struct):
    token: str
    logprob: float


class _Logprobs(msgspec.Struct):
    content: list[_Token] | None = None


class _Said(msgspec.Struct):
    content: str | None = None


class _Choice(msgspec.Struct):
    message: _Said
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
