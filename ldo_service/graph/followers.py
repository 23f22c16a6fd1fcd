"""Keyframes that are no variables any more: each keeps its place between two that are."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ldo_service.geometry.se3 import blended


@dataclass(frozen=True, slots=True)
class Followers:
    """F keyframes, each between the variables `heads` and `tails`, ids [F].

    T_head [F, 4, 4] is T_head_keyframe and T_tail T_tail_keyframe, as measured; `shares` [F] how
    far along it is: what corrections change between head and tail is spread over them.
    """

    keyframes: np.ndarray  # ascending within a group
    heads: np.ndarray
    tails: np.ndarray
    T_head: np.ndarray
    T_tail: np.ndarray
    shares: np.ndarray

    @staticmethod
    def none() -> "Followers":
        ids, transforms = np.zeros(0, np.int64), np.zeros((0, 4, 4))
        return Followers(ids, ids, ids, transforms, transforms, np.zeros(0))

    def joined_by(self, more: "Followers") -> "Followers":
        columns = (getattr(self, name) for name in self.__slots__)
        others = (getattr(more, name) for name in self.__slots__)
        return Followers(*map(np.concatenate, zip(columns, others, strict=True)))

    def only(self, row: int) -> "Followers":
        return Followers(*(getattr(self, name)[row : row + 1] for name in self.__slots__))

    def index(self) -> dict[int, int]:
        """Row of each keyframe."""
        return {int(k): row for row, k in enumerate(self.keyframes)}

    def placed(self, T_heads: np.ndarray, T_tails: np.ndarray) -> np.ndarray:
        """T_map_keyframe [F, 4, 4], from where heads and tails [F, 4, 4] are in the map."""
        return blended(T_heads @ self.T_head, T_tails @ self.T_tail, self.shares)

    def moved(self, row: int, T_head_keyframe: np.ndarray) -> "Followers":
        """One measured anew."""
        T_tail_head = self.T_tail[row] @ np.linalg.inv(self.T_head[row])
        T_head, T_tail = self.T_head.copy(), self.T_tail.copy()
        T_head[row], T_tail[row] = T_head_keyframe, T_tail_head @ T_head_keyframe
        return replace(self, T_head=T_head, T_tail=T_tail)

    def parted(self, row: int) -> "Followers":
        """Without one, which is a variable again: those of its group lie before or behind it."""
        of_group = (self.heads == self.heads[row]) & (self.tails == self.tails[row])
        share = self.shares[row]
        before, behind = of_group & (self.shares < share), of_group & (self.shares > share)
        to_head, to_tail = np.linalg.inv(self.T_head[row]), np.linalg.inv(self.T_tail[row])
        one = self.keyframes[row]
        parted = replace(
            self,
            heads=np.where(behind, one, self.heads),
            tails=np.where(before, one, self.tails),
            T_head=np.where(behind[:, None, None], to_head @ self.T_head, self.T_head),
            T_tail=np.where(before[:, None, None], to_tail @ self.T_tail, self.T_tail),
            shares=np.select(
                [before, behind],
                [self.shares / share, (self.shares - share) / (1 - share)],
                self.shares,
            ),
        )
        return parted.without(row)

    def without(self, row: int) -> "Followers":
        return Followers(*(np.delete(getattr(self, name), row, 0) for name in self.__slots__))

    def packed(self) -> dict[str, np.ndarray]:
        return {name: getattr(self, name) for name in self.__slots__}


def between(
    head: int,
    tail: int,
    keyframes: Sequence[int],
    T_head: np.ndarray,
    T_head_tail: np.ndarray,
) -> Followers:
    """Those that were made between two, one after another, T_head [n, 4, 4]."""
    n = len(keyframes)
    return Followers(
        np.array(keyframes, np.int64),
        np.full(n, head),
        np.full(n, tail),
        np.array(T_head),
        np.linalg.inv(T_head_tail) @ T_head,
        np.arange(1, n + 1) / (n + 1),
    )
