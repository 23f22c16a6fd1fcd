"""What somebody tries, what must come of it, and how to see what does."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

Where = TypeVar("Where")


@dataclass(frozen=True, slots=True)
class Attempt(Generic[Where]):
    says: str
    expected: str
    try_it: Callable[[Where], str]  # tells what was seen, in the words of `expected`

    def __str__(self) -> str:
        return self.says


def kept_in(
    attempts: list[Attempt[Where]],
) -> Callable[[str, str], Callable[[Callable[[Where], str]], None]]:
    """A decorator that keeps a function as an attempt."""

    def attempt(says: str, expected: str) -> Callable[[Callable[[Where], str]], None]:
        return lambda try_it: attempts.append(Attempt(says, expected, try_it))

    return attempt
