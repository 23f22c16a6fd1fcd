"""Self-calibration of a camera: its vignetting and the smooth bias of its depth.

Direct alignment mistakes both for a rotation of the camera. They are not noise, so that a wrong
pose looks certain. `SelfCalibration` estimates both from frames of the camera itself, and
`CameraCorrection` removes them from a frame. Conventions: `ldo_service.geometry`.
"""
