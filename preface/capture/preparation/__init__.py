"""From photographs to the images of a shard: framing, undistortion, downscaling and transfer.

    window = framing_window(camera, (512, 768), "whole")
    resampler = Resampler(camera, (512, 768), window, PreparationOptions())   # once per camera
    colors = resampler.colors(read_image(path))                               # uint8 [768, 512, 3], sRGB
    coverage = resampler.coverage(alpha)                                      # uint8 [768, 512]
    resampler.camera                                                          # the exact camera of both

Reading order: `options`, `windows` (which part, which camera), `transfer` (values, light, bytes), `filters`
(weights along an axis), `separable` (applying them fast), `places` and `undistortion` (to a pinhole), `resampling`.
"""

from preface.capture.preparation.options import PreparationError, PreparationOptions
from preface.capture.preparation.resampling import Resampler, split_alpha
from preface.capture.preparation.transfer import CutOff, cut_off
from preface.capture.preparation.windows import Window, camera_of_window, framing_window

__all__ = [
    "CutOff",
    "PreparationError",
    "PreparationOptions",
    "Resampler",
    "Window",
    "camera_of_window",
    "cut_off",
    "framing_window",
    "split_alpha",
]
