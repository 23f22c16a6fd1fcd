"""Self-calibration of a camera: its vignetting and the smooth bias of its depth.

Direct alignment mistakes both for a rotation of the camera. Both are systematic errors, so a wrong
pose would have a small uncertainty. `SelfCalibration` estimates both from frames of the camera, and
`CameraCorrection` removes them from a frame. Conventions: `ldo_service.geometry`.
"""
