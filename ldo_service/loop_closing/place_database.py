"""Place database: stored subgraphs, and the search for those that resemble a new one.

Histograms are compared by TF-IDF: the weight of a word depends on the number of stored subgraphs
that contain the word.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ldo_service.errors import ConfigError, named
from ldo_service.semantics.gaussian_labels import MAX_LABELS
from ldo_service.tracking.keyframe_database import neighbor_distances

from .object_points import LAYOUT_WORDS
from .subgraph import Subgraph


class Histograms:
    """Table of count histograms [N, W] float32, with document frequencies.

    similarity of rows a, b = cos(a * idf, b * idf),  idf_w = log(1 + N / n_w)

    Of the N rows, n_w contain the word w (Sivic and Zisserman 2003). Without the 1 in idf_w, a word
    in all rows would have no weight. This matters while there are few rows. Sums are computed in a
    fixed order on one thread, so that equal tables give bitwise equal similarities.

    >>> known = Histograms(2)
    >>> known.add(np.array([1.0, 0.0]))
    >>> known.add(np.array([1.0, 1.0]))
    >>> known.idf().astype(float).round(3).tolist()  # log(1 + 2 / 2), log(1 + 2 / 1)
    [0.693, 1.099]
    """

    def __init__(self, words: int) -> None:
        """Create an empty table for histograms of `words` words."""
        self._rows = np.zeros((16, words), np.float32)
        self._count = 0
        self._frequency = np.zeros(words, np.int64)

    def __len__(self) -> int:
        return self._count

    @property
    def rows(self) -> np.ndarray:
        """Histograms, [N, W]."""
        return self._rows[: self._count]

    def add(self, row: np.ndarray) -> None:
        """Append a histogram [W]; the capacity doubles if needed."""
        if self._count == len(self._rows):
            self._rows = np.concatenate([self._rows, np.zeros_like(self._rows)])
        self._rows[self._count] = row
        self._count += 1
        self._frequency += row > 0

    def remove(self, index: int) -> None:
        """Remove a row; later rows move up."""
        self._frequency -= self._rows[index] > 0
        self._rows[index : self._count - 1] = self._rows[index + 1 : self._count]
        self._count -= 1

    def idf(self) -> np.ndarray:
        """Return the weight of each word, [W] float32.

        A word in no row has the weight of a word in one row.
        """
        return np.log1p(self._count / np.maximum(self._frequency, 1)).astype(np.float32)

    def cosines(self, row: np.ndarray) -> np.ndarray:
        """Return the similarity 0..1 of a histogram [W] with each row, [N] float32.

        The similarity is 0 if the histogram or the row is empty.
        """
        weight = self.idf() ** 2
        product = np.einsum("nw,w->n", self.rows, weight * row.astype(np.float32))
        squares = np.einsum("nw,w->n", self.rows**2, weight)
        own = float(np.einsum("w,w,w->", row.astype(np.float32), row.astype(np.float32), weight))
        norms = np.sqrt(squares * own)
        return np.clip(np.where(norms > 0, product / np.where(norms > 0, norms, 1), 0), 0, 1)


Stages = Literal["two_stage", "semantic", "geometric"]


@dataclass(frozen=True, slots=True)
class RetrievalConfig:
    """Parameters of the search for similar subgraphs."""

    # The two keyframes of a loop closure are more than this number of camera frames apart
    # (LDO-SLAM paper, III.C). Subgraphs without such a pair of keyframes are not loop candidates.
    exclude_frames: int = 100
    candidates: int = 5  # K, the maximum number of candidates (LDO-SLAM paper, III.C).
    # theta_loop, the minimum cosine of the label histograms (LDO-SLAM paper, III.C).
    min_similarity: float = 0.75
    # A subgraph with different labels is also a candidate if the cosine of the visual words is at
    # least this value. For example, the cosine of the labels is below theta_loop if a detector
    # misses two of five objects. With a value above 1, similar labels are always required, as in
    # the LDO-SLAM paper.
    min_appearance: float = 0.35
    # Besides the `candidates` most similar subgraphs, the nearest other one in the map is a
    # candidate if the rotation plus parallax between a keyframe of each is at most this. At 0.7
    # rad, 30 % of a view of 1 rad remain in view. A place may look different from two sides.
    max_motion_rad: float = 0.7
    # Maximum number of stored subgraphs; if there are more, `PlaceDatabase` removes some.
    count: int = 1000

    def __post_init__(self) -> None:
        if self.exclude_frames < 0 or self.candidates < 1 or self.count < 3:
            raise ConfigError(
                named(self, "exclude_frames", "candidates", "count")
                + ": exclude_frames must be at least 0, candidates at least 1, and count at least "
                "3."
            )
        if not (
            0 <= self.min_similarity <= 1 and min(self.min_appearance, self.max_motion_rad) >= 0
        ):
            raise ConfigError(
                named(self, "min_similarity", "min_appearance", "max_motion_rad")
                + ": min_similarity must be within 0..1, and min_appearance and max_motion_rad "
                "must be at least 0."
            )


@dataclass(frozen=True, eq=False, slots=True)
class RetrievalMatch:
    """Stored subgraph that is similar to a new one or near it; cosines and score are 0..1."""

    subgraph: Subgraph
    similarity: float  # Cosine of the label histograms.
    layout: float  # Cosine of the histograms of pairs of labels and their distance.
    appearance: float  # Cosine of the visual-word histograms.
    # Score by which candidates are ranked: (appearance + (similarity + layout) / 2) / 2, if both
    # subgraphs have detections and no setting excludes labels or images. A subgraph that is near
    # but not similar has a score of 0.
    score: float
    is_near: bool = False  # True if the poses in the map make it a candidate.


class PlaceDatabase:
    """Stored subgraphs in the order of insertion, with tables of the histograms of the subgraphs.

    The setting `count` limits the number of subgraphs. If there are more, one subgraph is removed:
    the one whose previous and next subgraphs along the camera path are nearest to each other. In a
    long run, each part of the path thus keeps some subgraphs.
    """

    def __init__(self, words: int, stages: Stages, config: RetrievalConfig) -> None:
        """Create an empty database.

        Args:
            words: Number of visual words.
            stages: Descriptors to compare: labels and images, or only one of them.
            config: Parameters of the search.
        """
        self._stages, self._config = stages, config
        self.subgraphs: list[Subgraph] = []
        self._names = Histograms(MAX_LABELS)
        self._layout = Histograms(LAYOUT_WORDS)
        self._words = Histograms(words)

    def __len__(self) -> int:
        return len(self.subgraphs)

    def add(self, subgraph: Subgraph) -> None:
        """Store a subgraph; if there are now more than the setting `count`, remove one.

        The docstring of the class describes which subgraph is removed.
        """
        self.subgraphs.append(subgraph)
        self._names.add(subgraph.names)
        self._layout.add(subgraph.layout)
        self._words.add(subgraph.words)
        if len(self) > self._config.count:
            self._remove(
                int(np.argmin(neighbor_distances([s.views[0].place for s in self.subgraphs]))) + 1
            )

    def _remove(self, index: int) -> None:
        del self.subgraphs[index]
        for table in (self._names, self._layout, self._words):
            table.remove(index)

    def query(
        self, new: Subgraph, is_possible: np.ndarray, motion_rad: np.ndarray | None = None
    ) -> list[RetrievalMatch]:
        """Return the stored subgraphs that may show the same place, the likeliest first.

        The most similar subgraphs come first; the setting `candidates` limits their number. Of
        the remaining subgraphs, the one with the smallest `motion_rad` follows if this value is at
        most the setting `max_motion_rad`.

        Args:
            new: Subgraph to search for.
            is_possible: True for those of the S stored subgraphs to consider, [S] bool.
            motion_rad: Rotation plus parallax in the map between each stored subgraph and `new`,
                [S]; infinite where unknown. None if no pose is known.
        """
        if not self.subgraphs:
            return []
        similarity = self._names.cosines(new.names)
        layout = self._layout.cosines(new.layout)
        appearance = self._words.cosines(new.words)
        score = self._scores(new, similarity, layout, appearance)
        is_possible = self._are_far(new) & is_possible
        score[~is_possible] = 0
        ranked = np.argsort(-score, kind="stable")[: self._config.candidates]
        ranked = ranked[score[ranked] > 0]
        near = self._nearest(is_possible, ranked, motion_rad)
        return [
            RetrievalMatch(
                self.subgraphs[i],
                float(similarity[i]),
                float(layout[i]),
                float(appearance[i]),
                float(score[i]),
                is_near=i in near,
            )
            for i in [*ranked.tolist(), *near]
        ]

    def _nearest(
        self, is_possible: np.ndarray, ranked: np.ndarray, motion_rad: np.ndarray | None
    ) -> list[int]:
        """Return the nearest possible subgraph that is not among the ranked ones, if it is near.

        The stage `semantic` uses no poses of the map.
        """
        if motion_rad is None or self._stages == "semantic":
            return []
        others_rad = np.where(is_possible, motion_rad, np.inf)
        others_rad[ranked] = np.inf
        nearest = int(others_rad.argmin())
        return [nearest] if others_rad[nearest] <= self._config.max_motion_rad else []

    def _scores(
        self, new: Subgraph, similarity: np.ndarray, layout: np.ndarray, appearance: np.ndarray
    ) -> np.ndarray:
        """Return the scores of the S stored subgraphs, [S]; 0 for subgraphs that are no candidates.

        A stored subgraph is a candidate if its labels or its visual words are similar to those of
        the new subgraph. The score is (appearance + (similarity + layout) / 2) / 2. If either of
        the two subgraphs has no detections, only the visual words are used. The setting `stages`
        may also exclude labels or images.

        Args:
            new: New subgraph.
            similarity: Cosine of the label histograms of each stored subgraph, [S].
            layout: Cosine of the layout histograms, [S].
            appearance: Cosine of the visual-word histograms, [S].
        """
        config = self._config
        has_similar_images = appearance >= config.min_appearance
        if self._stages == "geometric":
            return np.where(has_similar_images, appearance, 0)
        has_similar_labels = similarity >= config.min_similarity
        named = (similarity + layout) / 2
        if self._stages == "semantic":
            return np.where(has_similar_labels, named, 0)
        both_have_labels = new.names.any() & self._names.rows.any(axis=1)
        both = np.where(has_similar_labels | has_similar_images, (named + appearance) / 2, 0)
        return np.where(both_have_labels, both, np.where(has_similar_images, appearance, 0))

    def _are_far(self, new: Subgraph) -> np.ndarray:
        """Return which subgraphs have a keyframe `exclude_frames` frames from a new one, [S] bool.

        The distance must be larger than `exclude_frames`. Subgraphs with much larger frame numbers
        than the new one are included too. They are older, because frame numbers restart at 0 when
        the camera restarts.
        """
        first = np.array([subgraph.first_frame for subgraph in self.subgraphs])
        last = np.array([subgraph.last_frame for subgraph in self.subgraphs])
        exclude = self._config.exclude_frames
        return (new.last_frame - first > exclude) | (last - new.first_frame > exclude)
