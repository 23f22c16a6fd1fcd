"""Self-calibration of a camera: its vignetting and the smooth bias of its depth.

Direct alignment mistakes both errors for a rotation of the camera. The errors are systematic. A
wrong pose would therefore still have a small covariance. `SelfCalibration` estimates both errors
from frames of the camera, and `CameraCorrection` removes them from a frame. Conventions:
`ldo_service.geometry`.
"""
