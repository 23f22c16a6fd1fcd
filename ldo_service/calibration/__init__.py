"""Self-calibration of a camera: its vignetting and the smooth bias of its depth.

Both look like rotation of the camera to direct alignment. Since neither is noise, they make a wrong
pose look certain. `SelfCalibration` estimates both from frames of the camera itself, and
`CameraCorrection` removes them from a frame. Conventions: `ldo_service.geometry`.
"""
