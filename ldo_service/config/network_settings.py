"""Settings of the detector, the labeller and the inference of their networks."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

from msgspec import Meta

from ldo_service.detection.dynamic_classes import DynamicClassConfig
from ldo_service.errors import ConfigError

from .values import (
    NonNegativeFloat,
    PositiveFloat,
    PositiveInt,
    Ratio,
    advanced,
)


@dataclass(frozen=True, slots=True)
class DetectorSettings:
    """Network that finds objects of known classes in keyframes."""

    # Detection network: a name from `ldo models list`, or an ONNX file. Empty disables detection.
    model: str = ""
    # File with one class name per line. Empty uses the names in the file of the network, or the 80
    # names of COCO if the network's file has none.
    class_names: str = ""
    # Minimum score of a detection. The default is that of YOLOv5 and YOLOX.
    min_score: Ratio = 0.25
    # COCO classes of objects that may move by themselves. Tracking and loop closing ignore their
    # pixels.
    dynamic_classes: tuple[str, ...] = DynamicClassConfig().classes
    # Output layout of the network. Empty recognizes the layout by the shape of the output.
    layout: Literal["", "yolov5", "yolox", "yolov8"] = advanced("")
    # Width and height of the input of a network that accepts any size, pixels.
    input_size_px: tuple[PositiveInt, PositiveInt] = advanced((640, 480))
    # IoU above which two boxes of one class are merged into one object, as in YOLOv5.
    nms_iou: Ratio = advanced(0.45)
    # Maximum number of detections per image, those with the highest scores, as in the evaluation of
    # COCO.
    max_detections: PositiveInt = advanced(100)


@dataclass(frozen=True, slots=True)
class InferenceSettings:
    """Inference of the detector's network and of the labeller's encoders."""

    # Threads of one inference on the CPU. With 1, a replay gives identical bits.
    threads: PositiveInt = 1


@dataclass(frozen=True, slots=True)
class EncoderSettings:
    """Pair of an image encoder and a text encoder, with which the labeller names regions."""

    # Prompts whose embeddings are averaged for each name; the name replaces {}.
    prompts: Annotated[tuple[str, ...], Meta(min_length=1)] = advanced(
        ("a photo of a {}.", "a cropped photo of a {}.", "a {} in a room.")
    )
    # Mean that normalizes RGB in 0..1. Empty uses the mean in the file of the encoder, or the
    # mean of CLIP if the file has none.
    image_mean: tuple[float, ...] = advanced(())
    # Standard deviation that normalizes RGB in 0..1. Empty uses the value in the file of the
    # encoder, or the value of CLIP if the file has none.
    image_std: tuple[PositiveFloat, ...] = advanced(())
    # Factor on the similarities before the softmax over names. A larger factor sharpens the
    # softmax. 0 uses the factor in the files of the pair, or 100 as in CLIP if the files have none.
    logit_scale: NonNegativeFloat = advanced(0.0)
    # Names such as wall and floor that compete with the other names but are never reported.
    background_names: tuple[str, ...] = advanced(())

    def __post_init__(self) -> None:
        for prompt in self.prompts:
            if prompt.count("{}") != 1 or prompt.count("{") + prompt.count("}") != 2:
                raise ConfigError(
                    f"vlm_labeller.encoder.prompts={list(self.prompts)} must contain {{}} once in "
                    "each prompt, in place of a class name."
                )
        for name, values in (("image_mean", self.image_mean), ("image_std", self.image_std)):
            if len(values) not in (0, 3):
                raise ConfigError(
                    f"vlm_labeller.encoder.{name}={list(values)} must be empty or 3 numbers."
                )
        if self.logit_scale == float("inf"):
            raise ConfigError("vlm_labeller.encoder.logit_scale=inf must be finite.")


@dataclass(frozen=True, slots=True)
class HttpSettings:
    """Vision-language model on an OpenAI-compatible server."""

    # Name of the model on the server. Empty uses the only model of the server.
    model: str = ""
    # Confidence of a label if the server returns no log-probabilities.
    default_confidence: Ratio = 0.3
    # Timeout of one attempt of a request to the server, seconds.
    timeout_s: PositiveFloat = 10.0
    # Timeout of the label of one region, with all views, attempts and waits, seconds. The sum of
    # deadline_s and timeout_s must be below service.control_timeout_s and
    # supervision.backend_step_timeout_s.
    deadline_s: PositiveFloat = 40.0
    # Environment variable with the API key. Empty sends no key.
    api_key_variable: str = ""
    # Maximum number of image crops of a region. Each crop is sent in a request of its own.
    max_views: PositiveInt = advanced(2)
    # Maximum number of attempts of a request.
    max_attempts: PositiveInt = advanced(3)
    # Maximum number of attempts per minute, which limits the cost. Attempts are evenly spaced.
    max_requests_per_minute: PositiveFloat = advanced(60.0)

    def __post_init__(self) -> None:
        if self.deadline_s < self.timeout_s:
            raise ConfigError(
                f"vlm_labeller.http.deadline_s={self.deadline_s:g} must be at least "
                f"vlm_labeller.http.timeout_s={self.timeout_s:g}, the time limit of one attempt."
            )


@dataclass(frozen=True, slots=True)
class VlmLabellerSettings:
    """Labeller of regions that the detector does not know."""

    # Encoder pair: a name from `ldo models list`, or a folder with its files. Empty uses none.
    model: str = ""
    # URL of an OpenAI-compatible server, such as http://127.0.0.1:8000/v1. Empty uses none.
    url: str = ""
    # File with the names from which the labeller chooses, one per line. Empty uses the names of the
    # encoder pair, or the 80 names of COCO if the pair has none.
    class_names: str = ""
    encoder: EncoderSettings = field(default_factory=EncoderSettings)
    http: HttpSettings = field(default_factory=HttpSettings)

    def __post_init__(self) -> None:
        if self.model and self.url:
            raise ConfigError(
                f"vlm_labeller.model={self.model} and vlm_labeller.url={self.url} exclude each "
                "other: choose one of them."
            )
