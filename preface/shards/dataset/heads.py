"""Making one head: its photographs are read, segmented and prepared, its cameras brought into the canonical frame.

One view at a time is held at full resolution. A view that cannot be used is left out with the reason; a view that is
odd (an empty mask, a foreground outside the box, a mask that contradicts the others) stays, and is named in the
head's metadata under "remarks".
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from preface.artifacts import ArtifactError
from preface.capture.foreground import Choice, Hints, Segmenter, hull_disagreement
from preface.capture.foreground.sheet import MaskFigures
from preface.capture.images import read_image
from preface.capture.preparation import PreparationError, Resampler, cut_off, framing_window
from preface.capture.upright import read_upright
from preface.geometry import Camera, GeometryError, Rigid, Views, cast_rays, intersect_box
from preface.shards.dataset.configuration import BuildConfiguration
from preface.shards.dataset.people import LeftOut, Person, View
from preface.shards.writer import Head

FOREGROUND = 128  # of 255: a pixel of which half is the person
MAX_RAYS = 4096  # of a view that are held against the box
DECIMALS = 4  # of shares in metadata
NO_METHOD = "none"  # everything is foreground: a mask that says nothing
OUTSIDE = 0.05  # share of a view's foreground outside the box that is worth a remark


@dataclass(frozen=True, eq=False)
class MadeView:
    """One view of a head.

    Attributes:
        camera: of the pixels.
        canonical_from_camera: its pose.
        pixels: uint8 [H, W, 4], sRGB and foreground share.
        figures: of its mask.
        remarks: what is odd, as sentences without a period.
    """

    camera: Camera
    canonical_from_camera: Rigid
    pixels: np.ndarray
    figures: MaskFigures
    remarks: tuple[str, ...]


class HeadMaker:
    """Makes heads in one process, whose models and resampling weights it keeps.

    Args:
        configuration: of the dataset.
        choices: take -> how the foreground is found.
    """

    def __init__(self, configuration: BuildConfiguration, choices: Mapping[str, Choice]):
        self._configuration = configuration
        self._choices = choices
        self._segmenters: dict[str, Segmenter] = {}
        self._resamplers: dict[tuple[str, str], Resampler] = {}

    def make(
        self, person: Person, cameras: Sequence[str], digests: Mapping[Path, str]
    ) -> tuple[Head | None, list[LeftOut]]:
        """Make the head of a person.

        Args:
            person: with the views to use.
            cameras: names of the dataset's V cameras.
            digests: file -> SHA-256, of all photographs.

        Returns:
            The head, None if not one view can be used; and what of the person's views is left out.
        """
        made: dict[str, MadeView] = {}
        left_out = []
        for view in person.views:
            try:
                made[view.camera] = self.make_view(person, view)
            except ArtifactError as error:
                reason = f"{error.path.name}: {error.field}: {error.problem}. {error.remedy}"
                left_out.append(LeftOut(person.identity, view.camera, reason))
            except (PreparationError, GeometryError) as error:
                left_out.append(LeftOut(person.identity, view.camera, str(error)))
        if not made:
            return None, [*left_out, LeftOut(person.identity, None, "not one of its views can be used")]
        head = self._head(person, cameras, made, digests, {e.camera: e.reason for e in left_out if e.camera})
        return head, left_out

    def make_view(self, person: Person, view: View) -> MadeView:
        """Make one view of a person.

        Raises:
            ArtifactError: a photograph, mask or plate that cannot be used.
            PreparationError: a window or values that cannot be used.
            GeometryError: a lens that folds inside the image.
        """
        resampler = self._resampler(person, view)  # first: it may refuse, and costs the least
        pixels = read_upright(view.photograph) if view.upright else read_image(view.photograph)
        lens = view.rig_camera.camera
        if pixels.shape[:2] != (lens.height, lens.width):
            problem = f"is {pixels.shape[1]}x{pixels.shape[0]}, but the rig has {lens.width}x{lens.height}"
            raise ArtifactError(view.photograph, "size", problem, "Calibrate with images of this size")
        hints = Hints(
            mask=None if view.mask is None else read_image(view.mask),
            plate=None if view.plate is None else read_image(view.plate),
            path=view.photograph,
        )
        foreground = self._segmenter(person.take)(pixels, hints)
        colors, coverage = resampler.foreground(foreground.pixels, foreground.alpha)
        rig_from_camera = view.rig_camera.camera_from_rig.inverse
        pose = person.canonical_from_rig.apply_to_pose(rig_from_camera)
        remarks = [*foreground.notes, *self._light_cut_off(pixels)]
        outside = share_outside(resampler.camera, pose, coverage, self._box)
        if not (coverage >= FOREGROUND).any():
            remarks.append("there is no foreground in it")
        elif outside > OUTSIDE:
            remarks.append(f"{100 * outside:.0f}% of its foreground lies outside the box")
        made = np.concatenate([colors, coverage[..., None]], axis=-1)
        figures = MaskFigures.of(person.identity, view.camera, foreground)
        return MadeView(resampler.camera, pose, made, figures, tuple(remarks))

    def _light_cut_off(self, pixels: np.ndarray) -> list[str]:
        """What is lost of a photograph of linear light, whose range the dataset's bytes do not have."""
        white = self._configuration.preparation.white
        lost = cut_off(pixels, white)
        shares = {f"brighter than the white of {white:g}": lost.above_white, "below zero": lost.below_black}
        return [
            f"{100 * share:.2g}% of its values are {what} and cut off"
            for what, share in shares.items()
            if share
        ]

    def _segmenter(self, take: str) -> Segmenter:
        if take not in self._segmenters:
            self._segmenters[take] = self._choices[take].segmenter()
        return self._segmenters[take]

    def _resampler(self, person: Person, view: View) -> Resampler:
        """The resampler of a camera; framing by the box has another one for every person."""
        lens, options, size = (
            view.rig_camera.camera,
            self._configuration.preparation,
            self._configuration.size,
        )
        key = person.take, view.camera
        if self._configuration.framing != "box" and key in self._resamplers:
            return self._resamplers[key]
        corners = np.array(list(product(*self._box.T)))
        in_rig = person.canonical_from_rig.inverse.apply(corners)
        in_camera = view.rig_camera.camera_from_rig.apply(in_rig)
        window = framing_window(lens, size, self._configuration.framing, in_camera)
        resampler = Resampler(lens, size, window, options)
        resampler.camera.require_unfolded()
        if self._configuration.framing != "box":
            self._resamplers[key] = resampler
        return resampler

    @property
    def _box(self) -> np.ndarray:
        return np.array(self._configuration.box).reshape(2, 3)

    # ------------------------------------------------------------------------------------ the head

    def _head(
        self,
        person: Person,
        cameras: Sequence[str],
        made: Mapping[str, MadeView],
        digests: Mapping[Path, str],
        left_out: Mapping[str, str],
    ) -> Head:
        some = next(iter(made.values()))
        slots = [made.get(camera, some) for camera in cameras]
        views = Views.stack([v.camera for v in slots], [v.canonical_from_camera for v in slots])
        files = {view.camera: view for view in person.views}
        sources = [
            {"file": files[c].name, "sha256": digests[files[c].photograph]} if c in made else None
            for c in cameras
        ]
        return Head(
            identity=person.identity,
            take=person.take,
            cameras=[camera if camera in made else None for camera in cameras],
            views=views,
            pixels=np.stack([view.pixels for view in slots]),
            box=self._box,
            keypoints=person.keypoints,
            backgrounds=[self._choices[person.take].background_kind] * len(cameras),
            sources=sources,
            metadata=self._metadata(person, made, left_out),
        )

    def _metadata(
        self, person: Person, made: Mapping[str, MadeView], left_out: Mapping[str, str]
    ) -> dict[str, Any]:
        remarks = {camera: list(view.remarks) for camera, view in made.items() if view.remarks}
        masks = {camera: described_mask(view.figures) for camera, view in made.items()}
        for camera, disagreement, flagged in self._disagreements(made):
            masks[camera]["disagreement"] = round(disagreement, DECIMALS)
            if flagged:
                masks[camera]["flagged"] = True
                words = f"{100 * disagreement:.0f}% of its mask disagrees with the other views'"
                remarks.setdefault(camera, []).append(words)
        found: dict[str, Any] = {**person.metadata, "masks": masks}
        if missing := {**person.left_out, **left_out}:
            found["left_out"] = missing
        if remarks:
            found["remarks"] = remarks
        return found

    def _disagreements(self, made: Mapping[str, MadeView]) -> list[tuple[str, float, bool]]:
        """Camera, how much of its mask disagrees with those of the others, and whether that is too much."""
        masked = {camera: view for camera, view in made.items() if view.figures.method != NO_METHOD}
        if not masked:
            return []
        alphas = [view.pixels[..., 3] for view in masked.values()]
        views = Views.stack(
            [v.camera for v in masked.values()], [v.canonical_from_camera for v in masked.values()]
        )
        check = hull_disagreement(alphas, views, self._box)
        named = zip(masked, check.disagreement.tolist(), check.flagged.tolist(), strict=True)
        return [(camera, share, flagged) for camera, share, flagged in named if np.isfinite(share)]


def described_mask(figures: MaskFigures) -> dict[str, Any]:
    """What metadata says of a mask, JSON types; `mask_figures` is the inverse."""
    share, soft = round(figures.share, DECIMALS), round(figures.soft, DECIMALS)
    return {"method": figures.method, "share": share, "soft": soft}


def mask_figures(identity: str, camera: str, metadata: Mapping[str, Any]) -> MaskFigures:
    """The figures of a view's mask, out of the metadata of its identity."""
    mask = metadata["masks"][camera]
    return MaskFigures(
        identity,
        camera,
        mask["method"],
        mask["share"],
        mask["soft"],
        mask.get("disagreement", float("nan")),
        mask.get("flagged", False),
        tuple(metadata.get("remarks", {}).get(camera, ())),
    )


def share_outside(
    camera: Camera, canonical_from_camera: Rigid, coverage: np.ndarray, box: np.ndarray
) -> float:
    """The share of a view's foreground, uint8 [H, W], whose rays miss a box [2, 3]; at most `MAX_RAYS` are cast."""
    rows, columns = np.nonzero(coverage >= FOREGROUND)
    if not len(rows):
        return 0.0
    some = np.linspace(0, len(rows) - 1, min(len(rows), MAX_RAYS)).astype(int)
    pixels = np.stack([columns[some], rows[some]], axis=-1) + 0.5
    rays = cast_rays(Views.stack([camera], [canonical_from_camera])[0], pixels)
    _, _, hit = intersect_box(box[0], box[1], rays.origins, rays.directions)
    return float(1 - np.mean(hit))
