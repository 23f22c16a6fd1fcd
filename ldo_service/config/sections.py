"""Root of the configuration with all its sections."""

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path

from ldo_service.errors import ConfigError

from .graph_settings import LoopCloserSettings, OptimizerSettings
from .mapper_settings import MapperSettings
from .network_settings import DetectorSettings, InferenceSettings, VlmLabellerSettings
from .paper_settings import PaperSettings
from .service_settings import (
    DatasetSettings,
    FrameSourceSettings,
    OfflineSettings,
    RecordingSettings,
    ServiceSettings,
    SupervisionSettings,
    ViewerSettings,
)
from .tracker_settings import TrackerSettings


@dataclass(frozen=True, slots=True)
class Config:
    """Root of the configuration; the module `parameters` converts it to actor parameters."""

    frame_source: FrameSourceSettings = field(default_factory=FrameSourceSettings)
    tracker: TrackerSettings = field(default_factory=TrackerSettings)
    detector: DetectorSettings = field(default_factory=DetectorSettings)
    inference: InferenceSettings = field(default_factory=InferenceSettings)
    vlm_labeller: VlmLabellerSettings = field(default_factory=VlmLabellerSettings)
    mapper: MapperSettings = field(default_factory=MapperSettings)
    loop_closer: LoopCloserSettings = field(default_factory=LoopCloserSettings)
    optimizer: OptimizerSettings = field(default_factory=OptimizerSettings)
    paper: PaperSettings = field(default_factory=PaperSettings)
    dataset: DatasetSettings = field(default_factory=DatasetSettings)
    offline: OfflineSettings = field(default_factory=OfflineSettings)
    service: ServiceSettings = field(default_factory=ServiceSettings)
    recording: RecordingSettings = field(default_factory=RecordingSettings)
    supervision: SupervisionSettings = field(default_factory=SupervisionSettings)
    viewer: ViewerSettings = field(default_factory=ViewerSettings)

    def check_timeouts(self) -> None:
        """Check that the service waits long enough for the server of the labeller.

        Raises:
            ConfigError: A timeout of the service is too short. Each timeout must exceed the
                deadline of a label request plus the time limit of one attempt.
        """
        http = self.vlm_labeller.http
        max_s = http.deadline_s + http.timeout_s  # Deadline of a label, plus one attempt as margin.
        limits = {
            "supervision.backend_step_timeout_s": self.supervision.backend_step_timeout_s,
            "service.control_timeout_s": self.service.control_timeout_s,
        }
        for name, limit_s in limits.items():
            if self.vlm_labeller.url and max_s >= limit_s:
                raise ConfigError(
                    f"the sum of vlm_labeller.http.deadline_s={http.deadline_s:g} and "
                    f"vlm_labeller.http.timeout_s={http.timeout_s:g} must be below "
                    f"{name}={limit_s:g}. Raise {name} or lower the other two."
                )

    def with_map_folder(self, folder: Path) -> "Config":
        """Return the configuration with a folder for images and offloaded Gaussians.

        If the setting `mapper.image_folder` is not empty, it has priority over the argument. A
        restored mapper finds its files in this folder.

        Args:
            folder: Folder within the state folder or the run folder.
        """
        image_folder = self.mapper.image_folder or str(folder)
        return dataclasses.replace(
            self, mapper=dataclasses.replace(self.mapper, image_folder=image_folder)
        )
