"""Which method finds the foreground of a take's photographs, and why that one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from preface.artifacts import ArtifactError
from preface.capture.foreground.backdrop import border_kind
from preface.capture.foreground.difference import BlackBackground, CleanPlate
from preface.capture.foreground.given import GivenMask, GivenWhereThereIsOne, Nothing
from preface.capture.foreground.matting import OnnxMatting
from preface.capture.foreground.result import Hints, Segmenter
from preface.capture.foreground.screen import GreenScreen
from preface.capture.foreground.selfie import Selfie
from preface.capture.images import ImageError, read_image
from preface.capture.manifest import Capture, Take
from preface.capture.upright import read_upright

METHODS = ("given", "green", "black", "plate", "selfie", "onnx", "none")
MAX_LOOKED_AT = 6  # photographs of a take whose borders are measured where nothing else decides
_SHARD_KINDS = ("black", "green", "plate")


@dataclass(frozen=True)
class Choice:
    """A method for the photographs of a take; small, comparable, and sent to worker processes as it is.

    Attributes:
        method: one of `METHODS`.
        reason: why, as a clause: "take01 says that its background is green".
        background_kind: what is behind the person, one of `preface.shards.format.BACKGROUND_KINDS`.
        given_first: whether a photograph that has a mask uses it, and the method is for the others.
        matting_model: the ONNX file of the method "onnx".
    """

    method: str
    reason: str
    background_kind: str
    given_first: bool = False
    matting_model: Path | None = None

    def segmenter(self) -> Segmenter:
        """A new segmenter, with its model loaded where the method has one; make one per process.

        Raises:
            ForegroundError: mediapipe or onnxruntime is not installed, or the model is not one.
        """
        made = make_segmenter(self.method, self.matting_model)
        return GivenWhereThereIsOne(made) if self.given_first else made


def make_segmenter(method: str, matting_model: Path | None = None) -> Segmenter:
    """The segmenter of a method.

    Raises:
        ValueError: not one of `METHODS`, or "onnx" without a model.
        ForegroundError: as `Choice.segmenter`.
    """
    if method == "onnx":
        if matting_model is None:
            raise ValueError("matting_model: the method 'onnx' needs the file of a matting model")
        return OnnxMatting.from_file(matting_model)
    plain: dict[str, type[Segmenter]] = {
        "given": GivenMask,
        "green": GreenScreen,
        "black": BlackBackground,
        "plate": CleanPlate,
        "selfie": Selfie,
        "none": Nothing,
    }
    if method not in plain:
        raise ValueError(f"method: {method!r} is not one of {', '.join(METHODS)}")
    return plain[method]()


def choose(
    capture: Capture,
    take: str,
    method: str = "auto",
    matting_model: Path | None = None,
    subjects: Sequence[str] | None = None,
) -> Choice:
    """Choose how the foreground of a take's photographs is found.

    "auto" takes, in this order: masks that every photograph has; the user's matting model; what the take says
    about its background; clean plates of every camera; a black or green border of the photographs themselves,
    measured on some of them; and MediaPipe's selfie segmentation. Where only some photographs have masks,
    these use them and the others use what comes next.

    Args:
        capture: the photographs, masks and plates.
        take: the take's id.
        method: "auto" or one of `METHODS`.
        matting_model: an ONNX file, needed for "onnx".
        subjects: the take's subjects that matter; all of them by default.

    Raises:
        ArtifactError: the method that was asked for lacks its masks, plates or model; an image is unreadable.
        ValueError: an unknown method or take.
    """
    if method not in ("auto", *METHODS):
        raise ValueError(f"method: {method!r} is neither 'auto' nor one of {', '.join(METHODS)}")
    found = next((entry for entry in capture.manifest.takes if entry.id == take), None)
    if found is None:
        raise ValueError(f"take: {take!r} is not a take of {capture.directory}")
    mine = [
        s.id for s in capture.manifest.subjects if s.take == take and (subjects is None or s.id in subjects)
    ]
    views = [view for view in capture.images if view[0] in mine]
    if method == "auto":
        return _automatic(capture, found, views, matting_model)
    _check_possible(capture, found, views, method, matting_model)
    kind = method if method in _SHARD_KINDS else _declared_kind(found)
    return Choice(method, "it was asked for", kind, False, matting_model if method == "onnx" else None)


def _automatic(
    capture: Capture, take: Take, views: list[tuple[str, str]], matting_model: Path | None
) -> Choice:
    masked = sum(view in capture.masks for view in views)
    if views and masked == len(views):
        return Choice("given", f"all {masked} photographs have a mask", _declared_kind(take))
    some = masked > 0
    before = f"{masked} of {len(views)} photographs have a mask and use it; for the others, " if some else ""
    if matting_model is not None:
        reason = f"{before}a matting model was given"
        return Choice("onnx", reason, _declared_kind(take), some, matting_model)
    cameras = {camera for _, camera in views}
    plated = sum((take.id, camera) in capture.plates for camera in cameras)
    if take.background in ("black", "green"):
        reason = f"{before}{take.id} says that its background is {take.background}"
        return Choice(take.background, reason, take.background, some)
    if cameras and plated == len(cameras):
        reason = f"{before}there are clean plates of all {plated} cameras"
        return Choice("plate", reason, "plate", some)
    if take.background == "plate":
        missing = sorted(camera for camera in cameras if (take.id, camera) not in capture.plates)
        problem = f"take {take.id} has no clean plate of {', '.join(missing[:5])}"
        remedy = "Add the plates, or choose another method for the foreground"
        raise ArtifactError(capture.directory, take.plates_folder, problem, remedy)
    kind, reason = _measured(capture, views)
    method = kind if kind in ("black", "green") else "selfie"
    return Choice(method, f"{before}{reason}", kind, some)


def _measured(capture: Capture, views: list[tuple[str, str]]) -> tuple[str, str]:
    """What the borders of some photographs show: "black", "green" or "natural", and the measurement in words."""
    picked = sorted({int(i) for i in np.linspace(0, len(views) - 1, min(len(views), MAX_LOOKED_AT))})
    kinds = []
    for index in picked:
        try:
            kinds.append(border_kind(read_upright(capture.images[views[index]])))
        except ImageError:
            continue  # whoever uses this photograph says what is wrong with it; the others are enough here
    for kind in ("black", "green"):
        if kinds and kinds.count(kind) > 0.5 * len(kinds):
            return kind, f"the border of {kinds.count(kind)} of {len(kinds)} photographs looked at is {kind}"
    return "natural", f"the border of the {len(kinds)} photographs looked at is neither black nor green"


def _declared_kind(take: Take) -> str:
    return take.background if take.background in _SHARD_KINDS else "unknown"


def _check_possible(
    capture: Capture, take: Take, views: list[tuple[str, str]], method: str, matting_model: Path | None
) -> None:
    """Refuse a method that was asked for and whose files are not there."""
    if method == "given" and (without := [view for view in views if view not in capture.masks]):
        problem = (
            f"{len(without)} of {len(views)} photographs of take {take.id} have no mask, the first being "
        )
        problem += " ".join(without[0])
        remedy = f"Put them at {capture.manifest.layout.masks}, or choose 'auto'"
        raise ArtifactError(capture.directory, "masks", problem, remedy)
    if method == "plate":
        cameras = sorted({c for _, c in views if (take.id, c) not in capture.plates})
        if cameras:
            problem = f"take {take.id} has no clean plate of {', '.join(cameras[:5])}"
            remedy = f"Put them at {take.plates_folder}/<camera>.*, or choose another method"
            raise ArtifactError(capture.directory, "plates", problem, remedy)
    if method == "onnx" and matting_model is None:
        remedy = "Name the ONNX file with --matting-model"
        raise ArtifactError(capture.directory, "matting model", "none was given", remedy)


def hints_of(capture: Capture, take: str, subject: str, camera: str) -> Hints:
    """The mask and plate of one photograph, decoded, where the capture has them."""
    mask, plate = capture.masks.get((subject, camera)), capture.plates.get((take, camera))
    return Hints(
        mask=None if mask is None else read_image(mask),
        plate=None if plate is None else read_image(plate),
        path=capture.images[subject, camera],
    )
