"""Settings of the region tracks: views, label requests, votes and mask propagation."""

from dataclasses import dataclass, field

from ldo_service.errors import ConfigError, named

from .region_views import ViewConfig

MAX_VIEWS = 8  # Maximum views in a label request.


@dataclass(frozen=True, slots=True)
class RegionTrackerConfig:
    """Settings of the region tracks."""

    views: int = 5  # Number of best views in a label request.
    views_first: int = 2  # Minimum views before a request; a single one may show a flaw of depth.
    patience: int = 3  # Keyframes without a better view before a request; one may yet come.
    max_requests: int = 3  # Maximum label requests for a region.
    # Label requests per keyframe; pending regions with the best views go first. Half of them
    # show no object. The paper requests on 10-25 % of the frames (IV.B.8); the flat, 1.0 per
    # keyframe.
    per_keyframe: float = 2.5
    at_once: int = 4  # Maximum requests saved up over keyframes without any.
    gain: float = 1.3  # Minimum ratio of the views' summed quality for another request.
    settled: float = 0.6  # Minimum confidence of a label result that needs no second one.
    # Weight of a label result, which is based on several views, relative to a box. All boxes of
    # one label together have the votes of one result with confidence 1.
    answer_weight: float = 4.0
    # True: boxes vote for the label of a region. False: they are fused per Gaussian (III.B), and
    # a region has the labeller's label only. Regions of a checkpoint keep their votes.
    boxes_vote: bool = True
    # Minimum votes for a label: one box with a score of 0.6, or four with 0.3.
    min_votes: float = 0.35
    # Minimum confidence of a label that is applied by mask propagation.
    min_propagation_confidence: float = 0.5
    # Maximum labels of a keyframe by mask propagation: as many as it has proposals.
    max_propagated: int = 32
    overlap: float = 0.6  # Minimum mutual overlap of two observations of one region.
    # Maximum depth difference between a point and the surface measured there (delta_z, III.A).
    max_gap_m: float = 0.1
    min_points: int = 12  # Minimum points of one observation that are visible in the other.
    min_quality: float = 0.02  # Minimum quality of a view; worse ones show a labeller nothing.
    # Maximum regions, some 50 kB each: five views of 5 kB, two masks of 12. The region not seen for
    # longest is dropped.
    most: int = 1024
    view: ViewConfig = field(default_factory=ViewConfig)

    def __post_init__(self) -> None:
        counts = self.views, self.views_first, self.max_requests, self.most, self.at_once
        if min(*counts, self.max_propagated) < 1:
            raise ConfigError(
                named(
                    self,
                    "views",
                    "views_first",
                    "max_requests",
                    "at_once",
                    "max_propagated",
                    "most",
                )
                + ": each must be at least 1."
            )
        if self.patience < 0 or self.per_keyframe <= 0:
            raise ConfigError(
                named(self, "patience", "per_keyframe")
                + ": patience must be at least 0, per_keyframe positive."
            )
        if not (0 <= self.min_quality <= 1 and 0 <= self.min_propagation_confidence <= 1):
            raise ConfigError(
                named(self, "min_propagation_confidence", "min_quality")
                + ": both must be in [0, 1]."
            )
        if self.views_first > self.views or not self.gain > 1:
            raise ConfigError(
                named(self, "views", "views_first", "gain")
                + ": views_first must be at most views, gain above 1."
            )
        if self.views > MAX_VIEWS:
            raise ConfigError(
                f"views={self.views} must be at most {MAX_VIEWS}, the maximum number of views in a "
                "label request."
            )
        if not (0 < self.overlap <= 1 and self.max_gap_m > 0 and self.min_points >= 1):
            raise ConfigError(
                named(self, "overlap", "max_gap_m", "min_points")
                + ": overlap must be in (0, 1], max_gap_m positive, min_points at least 1."
            )
        if not (self.answer_weight > 0 and self.min_votes >= 0):
            raise ConfigError(
                named(self, "answer_weight", "min_votes")
                + ": answer_weight must be positive, min_votes not negative."
            )

    @property
    def max_boxes(self) -> float:
        """Maximum sum of the votes of all boxes for one label."""
        return self.answer_weight if self.boxes_vote else 0.0
