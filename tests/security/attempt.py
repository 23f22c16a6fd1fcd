"""Attempt to misuse the service, with its expected result."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

Where = TypeVar("Where")


@dataclass(frozen=True, slots=True)
class Attempt(Generic[Where]):
    name: str
    expected: str
    try_it: Callable[[Where], str]  # Returns the result in the words of `expected`.

    def __str__(self) -> str:
        return self.name


def kept_in(
    attempts: list[Attempt[Where]],
) -> Callable[[str, str], Callable[[Callable[[Where], str]], None]]:
    """Return a decorator that adds a function to `attempts`."""

    def attempt(name: str, expected: str) -> Callable[[Callable[[Where], str]], None]:
        return lambda try_it: attempts.append(Attempt(name, expected, try_it))

    return attempt
