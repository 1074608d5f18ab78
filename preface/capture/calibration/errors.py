"""The one error of the calibration."""


class CalibrationError(ValueError):
    """Sightings that no rig, or no certain rig, explains; the message names the camera and the remedy."""
