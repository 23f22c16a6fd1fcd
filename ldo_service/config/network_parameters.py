"""Conversion of the configuration to the parameters of the detector and the labeller."""

from ldo_service.actors.detector import DetectorConfig
from ldo_service.actors.vlm_labeller import VlmLabellerConfig
from ldo_service.detection.detectors import NetworkConfig
from ldo_service.detection.labellers.chat_completion import HttpConfig
from ldo_service.detection.labellers.dual_encoder import DualEncoderConfig
from ldo_service.detection.labellers.http_endpoint import HttpClientConfig

from .sections import Config


def detector_parameters(config: Config) -> DetectorConfig:
    """Return the parameters of the detector."""
    detector = config.detector
    return DetectorConfig(
        model=detector.model,
        network=NetworkConfig(
            layout=detector.layout,
            names=detector.class_names,
            input_px=detector.input_size_px,
            score_min=detector.min_score,
            nms_iou=detector.nms_iou,
            max_boxes=detector.max_detections,
            device=config.service.device,
            threads=config.inference.threads,
        ),
    )


def labeller_parameters(config: Config) -> VlmLabellerConfig:
    """Return the parameters of the labeller."""
    labeller = config.vlm_labeller
    encoder, http = labeller.encoder, labeller.http
    return VlmLabellerConfig(
        model=labeller.model,
        url=labeller.url,
        names=labeller.class_names,
        dual_encoder=DualEncoderConfig(
            prompts=encoder.prompts,
            mean=encoder.image_mean,
            std=encoder.image_std,
            logit_scale=encoder.logit_scale,
            nothing=encoder.background_names,
            device=config.service.device,
            threads=config.inference.threads,
        ),
        http=HttpConfig(
            model=http.model,
            views=http.max_views,
            confidence_untold=http.default_confidence,
            endpoint=HttpClientConfig(
                timeout_s=http.timeout_s,
                attempts=http.max_attempts,
                patience_s=http.deadline_s,
                per_minute=http.max_requests_per_minute,
                key_variable=http.api_key_variable,
            ),
        ),
    )
