"""Calibration from photographs of no particular arrangement: one phone walked around a person, or an album.

`calibrate_photos` finds the photographs' poses by pycolmap's incremental mapping and their lens by held-out
evidence. `files` checks and decodes, `mapping` runs pycolmap, `structure` is what it found, `adjustment`
and `uncertainty` refine and judge that, `models` chooses the camera model, `calibrate` puts it together.
"""

from preface.capture.photos.calibrate import PhotoCalibration, PhotoOptions, calibrate_photos
from preface.capture.photos.files import PhotoError

__all__ = ["PhotoCalibration", "PhotoError", "PhotoOptions", "calibrate_photos"]
