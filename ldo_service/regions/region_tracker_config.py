"""Settings of the region tracks: views, label requests, votes and mask propagation."""

from dataclasses import dataclass, field

from ldo_service.errors import ConfigError, named

from .region_views import ViewConfig

MAX_VIEWS = 8  # Maximum views in a label request.


@dataclass(frozen=True, slots=True)
class RegionTrackerConfig:
    """Settings of the region tracks.

    A region track is an image region that is followed over keyframes. A view is a crop of one
    keyframe around the region. A label request sends the best views to the labeller.
    """

    views: int = 5  # Maximum views in a label request, the best ones.
    # Minimum views before a label request. A region with a single view may be an error of depth.
    views_first: int = 2
    # Keyframes without a better view after which a label is requested.
    patience: int = 3
    max_requests: int = 3  # Maximum label requests for a region.
    # Maximum number of label requests per keyframe, on average; regions with the best views come
    # first. Half of the regions show no object. The LDO-SLAM paper makes requests on 10-25 % of
    # the frames (IV.B.8). On the sequence `synthetic:flat`, 1.0 requests per keyframe are made.
    per_keyframe: float = 2.5
    # Maximum label requests at one keyframe, if earlier keyframes made fewer than per_keyframe.
    at_once: int = 4
    # Minimum factor by which the summed quality of a region's views grows between two of its label
    # requests.
    gain: float = 1.3
    # A label result with at least this confidence, or a box with at least this score, ends the
    # label requests of a region.
    settled: float = 0.6
    # Weight of the vote of a label result; a box has the weight 1. A label result weighs more,
    # because it is based on several views. All boxes with the same label together have at most as
    # many votes as one label result with confidence 1.
    answer_weight: float = 4.0
    # True: boxes vote for the label of a region. False: labels of boxes are fused per Gaussian
    # (LDO-SLAM paper, III.B), and only the labeller labels a region. A change of this setting
    # does not affect the votes of regions that are restored from a checkpoint.
    boxes_vote: bool = True
    # Minimum votes for a label: one box with a score of 0.6, or four with 0.3.
    min_votes: float = 0.35
    # Minimum confidence of a label that is applied by mask propagation.
    min_propagation_confidence: float = 0.5
    # Maximum labels by mask propagation per keyframe; equal to the maximum number of proposals.
    max_propagated: int = 32
    # Two observations show the same region if at least this fraction of the points of each lies in
    # the mask of the other.
    overlap: float = 0.6
    # Maximum difference between the depth of a visible point of a region and the measured depth at
    # the point's pixel (LDO-SLAM paper, III.A: delta_z).
    max_gap_m: float = 0.1
    # Minimum points of a region that must be visible in a keyframe to match the region there.
    min_points: int = 12
    # Minimum quality of a view; in worse views, a labeller recognizes nothing.
    min_quality: float = 0.02
    # Maximum regions; the ones observed longest ago are dropped. A region takes about 50 kB: five
    # views of 5 kB and two masks of 12 kB.
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
                + ": these settings must be at least 1."
            )
        if self.patience < 0 or self.per_keyframe <= 0:
            raise ConfigError(
                named(self, "patience", "per_keyframe")
                + ": patience must be at least 0, and per_keyframe must be positive."
            )
        if not (0 <= self.min_quality <= 1 and 0 <= self.min_propagation_confidence <= 1):
            raise ConfigError(
                named(self, "min_propagation_confidence", "min_quality")
                + ": both settings must be in [0, 1]."
            )
        if self.views_first > self.views or not self.gain > 1:
            raise ConfigError(
                named(self, "views", "views_first", "gain")
                + ": views_first must be at most views, and gain must be above 1."
            )
        if self.views > MAX_VIEWS:
            raise ConfigError(
                f"RegionTrackerConfig.views={self.views} must be at most {MAX_VIEWS}, the maximum "
                "number of views in a label request."
            )
        if not (0 < self.overlap <= 1 and self.max_gap_m > 0 and self.min_points >= 1):
            raise ConfigError(
                named(self, "overlap", "max_gap_m", "min_points")
                + ": overlap must be in (0, 1], max_gap_m above 0, and min_points at least 1."
            )
        if not (self.answer_weight > 0 and self.min_votes >= 0):
            raise ConfigError(
                named(self, "answer_weight", "min_votes")
                + ": answer_weight must be positive, and min_votes must be at least 0."
            )

    @property
    def max_box_votes(self) -> float:
        """Maximum vote sum of a label that boxes alone can reach; 0 if boxes do not vote."""
        return self.answer_weight if self.boxes_vote else 0.0
