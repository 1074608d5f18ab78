"""Calibrating a rig from sightings of a board: lenses, poses, the board's shape, and how well each is known.

Reading order: `views` and `state` (the knowns and the unknowns), `normal_equations`, `adjustment` (the
solver), `initial` and `spanning_tree` (where it starts), `covariance`, `determined` and `selection` (what
the sightings support), `colmap_backend` (a second opinion), `calibrate` (all of it in order).
"""

from preface.capture.calibration.calibrate import Calibration, CalibrationOptions, calibrate_rig
from preface.capture.calibration.covariance import Uncertainty
from preface.capture.calibration.errors import CalibrationError
from preface.capture.calibration.selection import Candidate

__all__ = [
    "Calibration",
    "CalibrationError",
    "CalibrationOptions",
    "Candidate",
    "Uncertainty",
    "calibrate_rig",
]
