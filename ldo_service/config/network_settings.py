"""Settings of the detector, the labeller and the inference of both."""

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

    # This is a name of `ldo models list` or an ONNX file. Empty disables detection.
    model: str = ""
    # This file has one class name a line. Empty takes the names that the network carries, or the 80
    # of COCO.
    class_names: str = ""
    # Boxes with a lower score are ignored. The default is that of YOLOv5 and YOLOX.
    min_score: Ratio = 0.25
    # Things of these COCO classes may move by themselves, so no pose and no loop relies on them.
    dynamic_classes: tuple[str, ...] = DynamicClassConfig().classes
    # This is the layout of the output. Empty recognizes it by the shape of the output.
    layout: Literal["", "yolov5", "yolox", "yolov8"] = advanced("")
    # A network with a free input size is given this width and height.
    input_size_px: tuple[PositiveInt, PositiveInt] = advanced((640, 480))
    # Boxes of one class that overlap more are one object, as in YOLOv5.
    nms_iou: Ratio = advanced(0.45)
    # An image has at most so many boxes, the most certain, as the evaluation of COCO counts.
    max_detections: PositiveInt = advanced(100)


@dataclass(frozen=True, slots=True)
class InferenceSettings:
    """Inference of the detector and of the encoder pair."""

    # These are the execution providers of onnxruntime in order of preference, such as cuda or
    # tensorrt.
    providers: tuple[str, ...] = ("cpu",)
    # One inference uses so many threads. With 1 a replay gives the same bits.
    threads: PositiveInt = 1


@dataclass(frozen=True, slots=True)
class EncoderSettings:
    """Pair of image and text encoders."""

    # The embeddings of these prompts are averaged for each name, which replaces {}.
    prompts: Annotated[tuple[str, ...], Meta(min_length=1)] = advanced(
        ("a photo of a {}.", "a cropped photo of a {}.", "a {} in a room.")
    )
    # RGB in 0..1 is normalized by this mean. Empty takes the mean of the encoder, or CLIP's.
    image_mean: tuple[float, ...] = advanced(())
    # RGB in 0..1 is normalized by this standard deviation. Empty takes that of the encoder, or
    # CLIP's.
    image_std: tuple[PositiveFloat, ...] = advanced(())
    # This factor makes the softmax over names sharper. 0 takes that of the pair, or CLIP's 100.
    logit_scale: NonNegativeFloat = advanced(0.0)
    # These names compete with the others and are never reported, such as wall and floor.
    background_names: tuple[str, ...] = advanced(())

    def __post_init__(self) -> None:
        for prompt in self.prompts:
            if prompt.count("{}") != 1 or prompt.count("{") + prompt.count("}") != 2:
                raise ConfigError(
                    f"vlm_labeller.encoder.prompts={list(self.prompts)} must have one {{}} for the "
                    "name in each prompt."
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
    """Vision-language model behind an OpenAI-compatible server."""

    # This is the name of the model on the server. Empty takes the only one.
    model: str = ""
    # A name counts with this confidence where the server returns no log-probabilities.
    default_confidence: Ratio = 0.3
    # One attempt to ask the server may take so long.
    timeout_s: PositiveFloat = 10.0
    # One region with all its views, attempts and waits may take so long. It must stay below
    # supervision.step_timeout_s.
    deadline_s: PositiveFloat = 40.0
    # This environment variable holds the API key. Empty sends no key.
    api_key_variable: str = ""
    # The server is asked about so many views of a region, one question each.
    max_views: PositiveInt = advanced(2)
    # A question that fails is repeated until so many attempts were made.
    max_attempts: PositiveInt = advanced(3)
    # Attempts are spaced evenly by this rate, which bounds the cost.
    max_requests_per_minute: PositiveFloat = advanced(60.0)

    def __post_init__(self) -> None:
        if self.deadline_s < self.timeout_s:
            raise ConfigError(
                f"vlm_labeller.http.deadline_s={self.deadline_s:g} must be at least "
                f"vlm_labeller.http.timeout_s={self.timeout_s:g}, which one attempt may take."
            )


@dataclass(frozen=True, slots=True)
class VlmLabellerSettings:
    """Names of regions that the detector does not know."""

    # This encoder pair is a name of `ldo models list` or a folder with its files. Empty uses none.
    model: str = ""
    # This is an OpenAI-compatible server such as http://127.0.0.1:8000/v1. Empty uses none.
    url: str = ""
    # This file has one name a line to choose from. Empty takes the names of the pair, or the 80 of
    # COCO.
    class_names: str = ""
    encoder: EncoderSettings = field(default_factory=EncoderSettings)
    http: HttpSettings = field(default_factory=HttpSettings)

    def __post_init__(self) -> None:
        if self.model and self.url:
            raise ConfigError(
                f"vlm_labeller.model={self.model} and vlm_labeller.url={self.url}: choose one of "
                "them."
            )
