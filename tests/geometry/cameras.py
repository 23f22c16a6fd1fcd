"""Cameras and lenses that several tests of geometry use."""

from ldo_service.geometry import Camera

FREIBURG1 = (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)  # Distortion of TUM freiburg1.
CAMERA = Camera(64, 48, 50.0, 50.0, 31.0, 24.0)
FINER = Camera(130, 97, 101.2, 101.4, 64.7, 48.4)  # The ratio is that of color to depth in ScanNet.
COARSER = Camera(32, 24, 25.0, 25.0, 15.25, 11.75)
COLOR_CAMERAS = {"finer": FINER, "coarser": COARSER, "alike": CAMERA}
