"""An image scaled into the input of a network, and boxes scaled back."""

from dataclasses import dataclass

import cv2
import numpy as np

PADDING = 114  # the grey that the YOLO family is trained with


@dataclass(frozen=True, slots=True)
class Letterbox:
    """Where in the input of a network the image lies: all of it, in proportion, on grey.

    image_px   width, height of the image
    input_px   width, height of the network's input
    inner_px   width, height of the scaled image
    offset_px  of the scaled image's upper left corner in the input
    """

    image_px: tuple[int, int]
    input_px: tuple[int, int]
    inner_px: tuple[int, int]
    offset_px: tuple[int, int]

    @staticmethod
    def fit(image_px: tuple[int, int], input_px: tuple[int, int], is_centred: bool) -> "Letterbox":
        """Centred as YOLOv5 has it, or in the upper left corner as YOLOX does."""
        scale = min(input_px[0] / image_px[0], input_px[1] / image_px[1])
        inner = max(1, round(image_px[0] * scale)), max(1, round(image_px[1] * scale))
        room = input_px[0] - inner[0], input_px[1] - inner[1]
        offset = (room[0] // 2, room[1] // 2) if is_centred else (0, 0)
        return Letterbox(image_px, input_px, inner, offset)

    def canvas(self, image: np.ndarray) -> np.ndarray:
        """The input [h, w, 3] uint8 for an image [H, W, 3] uint8."""
        width, height = self.input_px
        canvas = np.full((height, width, 3), PADDING, np.uint8)
        (left, top), (inner_width, inner_height) = self.offset_px, self.inner_px
        inner = cv2.resize(image, self.inner_px, interpolation=cv2.INTER_LINEAR)
        canvas[top : top + inner_height, left : left + inner_width] = inner
        return canvas

    def to_image(self, boxes: np.ndarray) -> np.ndarray:
        """Boxes [M, 4] (x0, y0, x1, y1) of the input in pixels of the image, clipped to it.

        Networks count from the corner of the first pixel, this project from its centre:
        x_image = (x_input - offset) * W / w - 0.5, so that the image covers -0.5 .. W - 0.5.
        """
        scale = np.divide(self.image_px, self.inner_px)
        corners = (boxes.reshape(-1, 2, 2) - self.offset_px) * scale
        return (np.clip(corners, 0, self.image_px) - 0.5).reshape(-1, 4)
