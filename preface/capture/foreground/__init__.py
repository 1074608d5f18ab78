"""Foreground: which part of a photograph is the person, by whichever way a capture allows.

One interface, `Segmenter`, and several ways behind it (`METHODS`): masks that are given, a green screen, a
black background, a clean plate, MediaPipe's selfie segmentation, a user's ONNX matting model, or nothing.
`choose` picks one for a take and says why; `hull_disagreement` finds masks that contradict those of the other
views; `mask_report` shows edges over photographs, worst first.

    choice = choose(capture, "take01")                     # Choice("green", "take01 says that ...", ...)
    segmenter = choice.segmenter()                         # one per process
    found = segmenter(read_image(path), hints_of(capture, "take01", "id0032", "cam00"))
    found.alpha, found.pixels                              # float32 [h, w]; as read, without the screen's light

Reading order: `result` (what goes in and out), `choosing`, `light`, `fields`, `backdrop`, `unmixing`, then the
methods `given`, `screen`, `difference`, `selfie`, `matting`, and `hull` and `sheet` which judge them.
"""

from preface.capture.foreground.choosing import METHODS, Choice, choose, hints_of, make_segmenter
from preface.capture.foreground.hull import HullCheck, hull_disagreement
from preface.capture.foreground.result import Foreground, ForegroundError, Hints, Segmenter
from preface.capture.foreground.sheet import MaskFigures, mask_report, worst_first

__all__ = [
    "METHODS",
    "Choice",
    "Foreground",
    "ForegroundError",
    "Hints",
    "HullCheck",
    "MaskFigures",
    "Segmenter",
    "choose",
    "hints_of",
    "hull_disagreement",
    "make_segmenter",
    "mask_report",
    "worst_first",
]
