"""`calibrate_photos`: from photographs to a rig with one camera per photograph."""

import math
import os
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from preface.capture.photos.adjustment import adjust
from preface.capture.photos.files import PhotoError, Photograph, Sharing, find_photographs, stage
from preface.capture.photos.mapping import Mapped, MappingError, MappingOptions, map_photographs
from preface.capture.photos.models import (
    MAX_FOCAL_DEVIATION,
    MIN_HELD_OUT,
    Candidate,
    NoPlausibleModelError,
    choose_model,
)
from preface.capture.photos.structure import Structure, Tracks, rms
from preface.capture.rig import HeldOutError, ReprojectionError, Rig, RigCamera
from preface.geometry.transforms import Rigid

# Of one EXIF focal length to another among photographs said to share a lens: more is a zoom.
MAX_ZOOM = 1.05


@dataclass(frozen=True)
class PhotoOptions:
    """How to calibrate photographs.

    Attributes:
        cameras: which photographs share a lens: all of them (one), those of a subfolder (folder), or none
            (each).
        take: the name of the take in the rig.
        masks: folder with a mask <photograph>.png for each photograph; features are sought where it is not 0.
            Without it they are sought everywhere, which is right when the person sits still before a still
            background; mask the background when the person turned instead of the photographer.
        known_distance: two photographs' ids and the distance between their cameras in metres, which sets the
            scale; without it the scale is arbitrary.
        max_image_size: longer side at which features are sought, pixels; larger photographs are reduced.
        max_features: sought in each photograph.
        folds: in how many parts sightings are held out to choose the camera model.
        seed: of everything random.
        threads: 0 for all cores; 1 for results that repeat exactly.
    """

    cameras: Sharing = "one"
    take: str = "photos"
    masks: Path | None = None
    known_distance: tuple[str, str, float] | None = None
    max_image_size: int = 3200
    max_features: int = 8192
    folds: int = 4
    seed: int = 0
    threads: int = 0


@dataclass(frozen=True)
class PhotoCalibration:
    """What the photographs gave.

    Attributes:
        photographs: all of them, in the order of their names or as given.
        rig: a camera for each registered photograph, in the frame of the first one's.
        missing: why each other photograph was not registered, by id.
        candidates: the camera models that were tried, from simple to complex.
        chosen: index of the one in the rig.
        scale: where the rig's unit of length comes from.
        warnings: what the user should know before trusting the rig.
        structure: the rig's cameras, and the points, in the rig's frame and unit.
        tracks: the sightings.
    """

    photographs: tuple[Photograph, ...]
    rig: Rig
    missing: Mapping[str, str]
    candidates: tuple[Candidate, ...]
    chosen: int
    scale: str
    warnings: tuple[str, ...]
    structure: Structure
    tracks: Tracks


def calibrate_photos(
    images: str | os.PathLike[str] | Sequence[Path], options: PhotoOptions | None = None
) -> PhotoCalibration:
    """Calibrate photographs of one scene.

    With one thread the same photographs and seed give the same result. With more, pycolmap's threads work in
    an order of their own, and results differ by a fraction of their standard deviations.
    All intermediate files lie in a temporary folder, which is removed.

    Args:
        images: a folder or the files.
        options: settings.

    Returns:
        The rig and how it came about.

    Raises:
        PhotoError: fewer than two photographs, sizes that differ, nothing that matches, an unknown or
            unregistered photograph in ``known_distance``, or no plausible camera model.
        ImageError: a file that cannot be read, or that EXIF wants rotated.
    """
    options = options or PhotoOptions()
    threads = options.threads or os.cpu_count() or 1
    photographs = find_photographs(images, options.cameras)
    place = photographs[0].path.parent if not isinstance(images, str | os.PathLike) else Path(images)
    _check_distance(place, photographs, options.known_distance)
    mapped = _map(place, photographs, options, threads)
    try:
        candidates, chosen = choose_model(
            mapped.structure, mapped.tracks, options.folds, options.seed, threads
        )
    except NoPlausibleModelError as error:
        raise _implausible(place, error) from error
    ids = [photographs[index].id for index in mapped.images]
    missing = {photographs[index].id: reason for index, reason in mapped.missing.items()}
    # Candidates may have been fitted to a part of the tracks; the rig has the benefit of all.
    refined = adjust(
        replace(mapped.structure, cameras=candidates[chosen].structure.cameras),
        mapped.tracks,
        candidates[chosen].refine,
        threads,
    )
    factor, scale = _scale(place, refined, mapped.tracks, ids, options.known_distance)
    structure = refined.in_frame_of_image(0, factor)
    table = [candidate.summary() | {"chosen": index == chosen} for index, candidate in enumerate(candidates)]
    metadata = {"scale": scale, "not_registered": missing, "camera_models": table}
    return PhotoCalibration(
        photographs=tuple(photographs),
        rig=replace(
            _rig(options.take, ids, structure, mapped.tracks, candidates[chosen], metadata),
            scale="arbitrary" if options.known_distance is None else "metric",
        ),
        missing=missing,
        candidates=candidates,
        chosen=chosen,
        scale=scale,
        warnings=tuple(_warnings(photographs, mapped, candidates[chosen], scale)),
        structure=structure,
        tracks=mapped.tracks,
    )


def _map(place: Path, photographs: list[Photograph], options: PhotoOptions, threads: int) -> Mapped:
    settings = MappingOptions(options.max_image_size, options.max_features, options.seed, threads)
    with tempfile.TemporaryDirectory(prefix="preface-photos-") as folder:
        names = stage(photographs, options.masks, Path(folder), threads)
        try:
            return map_photographs(photographs, names, Path(folder), options.masks is not None, settings)
        except MappingError as error:
            remedy = (
                "Give sharp photographs of one scene with texture in view, taken while walking around it, "
                "neighbours about 10 degrees apart"
            )
            raise PhotoError(place, "photographs", str(error), remedy) from error


def _check_distance(
    place: Path, photographs: list[Photograph], known_distance: tuple[str, str, float] | None
) -> None:
    if known_distance is None:
        return
    first, second, metres = known_distance
    ids = [photograph.id for photograph in photographs]
    for name in (first, second):
        if name not in ids:
            some = ", ".join(ids[:5])
            raise PhotoError(place, "known_distance", f"'{name}' is no photograph", f"They are {some}, ...")
    if first == second or not (math.isfinite(metres) and metres > 0):
        problem = f"{metres} m from '{first}' to '{second}' is no distance between two cameras"
        raise PhotoError(place, "known_distance", problem, "Give two photographs and a positive distance")


def _scale(
    place: Path,
    structure: Structure,
    tracks: Tracks,
    ids: list[str],
    known_distance: tuple[str, str, float] | None,
) -> tuple[float, str]:
    """The factor from the structure's unit to the rig's, and where it comes from."""
    if known_distance is None:
        depth = float(np.median(structure.in_cameras(tracks)[:, 2]))
        return 1 / depth, "arbitrary: the median depth of points is 1; the face or a known distance sets it"
    first, second, metres = known_distance
    for name in (first, second):
        if name not in ids:
            raise PhotoError(
                place,
                "known_distance",
                f"'{name}' could not be registered",
                "Give the distance between two others",
            )
    centres = structure.centres
    found = float(np.linalg.norm(centres[ids.index(first)] - centres[ids.index(second)]))
    return metres / found, f"the cameras of '{first}' and '{second}' are {metres:g} m apart"


def _rig(
    take: str,
    ids: list[str],
    structure: Structure,
    tracks: Tracks,
    chosen: Candidate,
    metadata: Mapping[str, object],
) -> Rig:
    errors = structure.reprojection_errors(tracks)
    errors = np.where(np.isfinite(errors), errors, np.nan)
    cameras = {}
    for index, name in enumerate(ids):
        pose = structure.camera_from_world
        mine = errors[(tracks.image == index) & np.isfinite(errors)]
        cameras[name] = RigCamera.at(
            structure.cameras[tracks.camera_of_image[index]],
            Rigid(pose.rotation[index], pose.translation[index]),
            reprojection_error=ReprojectionError(rms(mine), float(np.median(mine)), len(mine)),
        )
    held_out = None
    if chosen.held_out is not None:
        held_out = HeldOutError(rms(chosen.held_out.errors), len(chosen.held_out.errors))
    return Rig(take, cameras, held_out, metadata=metadata)


def _warnings(photographs: Sequence[Photograph], mapped: Mapped, chosen: Candidate, scale: str) -> list[str]:
    warnings = []
    if len(mapped.images) < len(photographs) / 2:
        some = ", ".join(photographs[index].path.name for index in list(mapped.missing)[:5])
        warnings.append(
            f"only {len(mapped.images)} of {len(photographs)} photographs were registered (not {some}"
            f"{', ...' if len(mapped.missing) > 5 else ''}): add sharp ones from viewpoints in between"
        )
    for camera in mapped.cameras:
        mine = [photograph for photograph in photographs if photograph.camera == camera]
        with_focal = [p for p in mine if p.exif_focal]
        focals = sorted(with_focal, key=lambda p: p.exif_focal or 0.0)
        if focals and (focals[-1].exif_focal or 0.0) > MAX_ZOOM * (focals[0].exif_focal or 0.0):
            warnings.append(
                f"EXIF gives focal lengths from {focals[0].exif_focal:.0f} px ({focals[0].path.name}) to "
                f"{focals[-1].exif_focal:.0f} px ({focals[-1].path.name}) for one camera: if it was zoomed, "
                "say that each photograph has its own camera"
            )
    if chosen.held_out is None:
        warnings.append(
            f"fewer than {MIN_HELD_OUT} sightings could be held out, so that the camera model is the simplest "
            "and not chosen by evidence: give at least four photographs that overlap well"
        )
    for lens, deviations in zip(chosen.structure.cameras, chosen.deviations, strict=True):
        focal, relative = lens.params[0], deviations[0] / lens.params[0]  # comes first in every model
        if not relative <= MAX_FOCAL_DEVIATION:
            warnings.append(
                f"the focal length of {focal:.0f} px is known to {relative:.0%} only: give photographs from "
                "more directions and distances"
            )
    if scale.startswith("arbitrary"):
        warnings.append("the rig's scale is arbitrary: give a known distance, or let the face set it")
    return warnings


def _implausible(place: Path, error: NoPlausibleModelError) -> PhotoError:
    return PhotoError(
        place,
        "camera model",
        f"every one that was tried is implausible: {error}",
        "Give photographs from more directions and distances, uncropped, and of one zoom setting",
    )
