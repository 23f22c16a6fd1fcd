"""Class names with indices that never change; saved with the map."""

from typing import Any

from ldo_service.errors import ConfigError

from .class_names import COCO
from .synonyms import canonical

BACKGROUND, OTHER = 0, 1
FIRST_NAMES = ("background", "other", *COCO)
CAP = 256  # C_max: what one byte can number


class Vocabulary:
    """`background`, `other`, the 80 names of COCO, then every new name in the order it comes.

    Names that mean the same share an index, see `synonyms`. Beyond `cap` names, a new one is
    `other`.

    Raises ConfigError for a cap below the names it starts with.
    """

    def __init__(self, cap: int = CAP) -> None:
        if cap < len(FIRST_NAMES):
            raise ConfigError(
                f"a vocabulary of {cap} has no room for the {len(FIRST_NAMES)} names it starts "
                "with: raise the cap."
            )
        self.cap = cap
        self._names: list[str] = [*FIRST_NAMES]
        self._indices = {name: index for index, name in enumerate(FIRST_NAMES)}
        self.refused = 0  # times that a new name became `other`

    def __len__(self) -> int:
        return len(self._names)

    def __contains__(self, name: str) -> bool:
        return self.find(name) is not None

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self._names)

    def name(self, index: int) -> str:
        return self._names[index]

    def find(self, name: str) -> int | None:
        """The index of a known name; None for one that is not known."""
        return self._indices.get(canonical(name))

    def index(self, name: str) -> int:
        """The index of a name, which is new from now on if it was not known; `other` when there is
        no room, or no name."""
        plain = canonical(name)
        if plain in self._indices:
            return self._indices[plain]
        if not plain or len(self) >= self.cap:
            self.refused += 1
            return OTHER
        self._indices[plain] = len(self)
        self._names.append(plain)
        return self._indices[plain]

    @property
    def packed(self) -> dict[str, Any]:
        """Plain values, for a file or a state."""
        return {"cap": self.cap, "names": list(self._names), "refused": self.refused}

    @staticmethod
    def unpacked(packed: dict[str, Any]) -> "Vocabulary":
        """As it was, whatever has become a synonym since. Raises ValueError when these are not the
        names of a vocabulary."""
        names, vocabulary = packed["names"], Vocabulary(packed["cap"])
        start = len(FIRST_NAMES)
        if tuple(names[:start]) != FIRST_NAMES or not start <= len(names) <= vocabulary.cap:
            raise ValueError(f"{len(names)} names, not those that every vocabulary starts with")
        vocabulary._names = list(names)
        vocabulary._indices = {name: index for index, name in enumerate(names)}
        if len(vocabulary._indices) != len(names):
            raise ValueError("the vocabulary has a name twice")
        vocabulary.refused = packed["refused"]
        return vocabulary
