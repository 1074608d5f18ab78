"""Contact sheets of landmarks over the photographs, the views that deserve a look first."""

from collections.abc import Callable, Sequence

import cv2
import numpy as np

from preface.align.aligned import AlignedStudio
from preface.align.landmarks import NoFace, ViewLandmarks
from preface.reports import contact_sheet, overlay_points
from preface.reports.pictures import GREEN, Color, Picture, as_picture

View = tuple[str, str]  # identity, camera
LoadImage = Callable[[str, str], np.ndarray | None]  # an image [H, W, 3] uint8, where it is at hand

TILE = (232, 260)  # pixels
COLUMNS = 5
MARGIN = 0.3  # of the face's box, shown around it
RED: Color = (255, 90, 80)
YELLOW: Color = (255, 210, 60)
BLUE: Color = (90, 180, 255)


def worst_first(studio: AlignedStudio) -> list[View]:
    """All views with landmarks: those left out, then those used by their disagreement, unchecked ones last."""

    def badness(view: View) -> tuple[bool, float]:
        disagreement = studio.disagreement(*view)
        return studio.used(*view), 1.0 if np.isnan(disagreement) else -disagreement

    return sorted(
        (v for v, found in studio.landmarks.items() if isinstance(found, ViewLandmarks)), key=badness
    )


def landmark_sheet(studio: AlignedStudio, views: Sequence[View], load_image: LoadImage) -> Picture:
    """One tile per view: dots are landmarks, blue circles the five keypoints as this view has them, and yellow
    circles the 3D keypoints' projections. Green dots are used; red ones are not.
    """
    return contact_sheet([_tile(studio, view, load_image) for view in views], COLUMNS, TILE)


def photograph_sheet(views: Sequence[View], load_image: LoadImage) -> Picture:
    """One tile per view, with nothing drawn."""
    tiles = []
    for identity, camera in views:
        image = load_image(identity, camera)
        shown = (
            None
            if image is None
            else _enlarged(as_picture(image), np.zeros(2), np.array(image.shape[1::-1]))[0]
        )
        tiles.append((shown, f"{identity} {camera}"))
    return contact_sheet(tiles, COLUMNS, TILE)


def _tile(studio: AlignedStudio, view: View, load_image: LoadImage) -> tuple[Picture | None, str]:
    identity, camera = view
    found, image = studio.landmarks[view], load_image(identity, camera)
    caption = f"{identity} {camera}\n{_verdict(studio, identity, camera)}"
    if image is None or isinstance(found, NoFace):
        return None, caption
    good = _inliers(studio, identity, camera, len(found.pixels))
    projected = _projected_keypoints(studio, identity, camera)
    left, top, right, bottom = found.face_box
    side = np.array([right - left, bottom - top])
    low = np.array([left, top]) - MARGIN * side
    picture, scale, origin = _cut(as_picture(image), low, low + (1 + 2 * MARGIN) * side)
    for chosen, color in ((found.seen & ~good, RED), (found.seen & good, GREEN)):
        _dots(picture, (found.pixels[chosen] - origin) * scale, color)
    picture = overlay_points(picture, (found.keypoints - origin) * scale, None, 3.0, BLUE)
    return overlay_points(picture, (projected - origin) * scale, None, 5.0, YELLOW), caption


def _verdict(studio: AlignedStudio, identity: str, camera: str) -> str:
    """How a view agrees: per cent of the eye distance, or where nothing checks it, its reprojection error."""
    verdict, disagreement = studio.subjects[identity].views.get(camera), studio.disagreement(identity, camera)
    code = "not used" if verdict is None else verdict.code.replace("_", " ")
    errors = studio.reprojection_errors(identity, camera)
    if not np.isnan(disagreement):
        size = f"{disagreement:.1f} %"
    elif errors.size:
        size = f"{np.median(errors):.1f} px"
    else:
        return code
    return size if code == "agrees" else f"{size} {code}"


def _inliers(studio: AlignedStudio, identity: str, camera: str, count: int) -> np.ndarray:
    subject = studio.subjects[identity]
    if camera not in subject.cameras:
        return np.zeros(count, bool)
    return subject.landmarks.inliers[:, subject.cameras.index(camera)]


def _projected_keypoints(studio: AlignedStudio, identity: str, camera: str) -> np.ndarray:
    """Where the camera should see the 3D keypoints [5, 2], pixels; NaN where it does not or they are missing."""
    points, standing = (
        studio.subjects[identity].keypoints.positions,
        studio.rigs[identity].cameras.get(camera),
    )
    pixels = np.full((len(points), 2), np.nan)
    known = np.isfinite(points).all(axis=-1)
    if standing is not None and known.any():
        found, valid = standing.camera.project(standing.camera_from_rig.apply(points[known]))
        pixels[known] = np.where(valid[:, None], found, np.nan)
    return pixels


def _cut(picture: Picture, low: np.ndarray, high: np.ndarray) -> tuple[Picture, float, np.ndarray]:
    """The part of a picture between two corners, scaled to a tile; the scale, and the part's own corner."""
    size = np.array(picture.shape[1::-1])
    first = np.clip(np.floor(low), 0, size - 1).astype(int)
    last = np.clip(np.ceil(high), first + 1, size).astype(int)
    return (*_enlarged(picture, first, last), first.astype(float))


def _enlarged(picture: Picture, first: np.ndarray, last: np.ndarray) -> tuple[Picture, float]:
    part = picture[int(first[1]) : int(last[1]), int(first[0]) : int(last[0])]
    scale = min(TILE[0] / part.shape[1], TILE[1] / part.shape[0])
    size = max(1, round(part.shape[1] * scale)), max(1, round(part.shape[0] * scale))
    method = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(part, size, interpolation=method), np.uint8), scale


def _dots(picture: Picture, points: np.ndarray, color: Color) -> None:
    for x, y in points[np.isfinite(points).all(axis=-1)]:
        cv2.circle(
            picture, (round((x - 0.5) * 16), round((y - 0.5) * 16)), 16, color, -1, cv2.LINE_AA, shift=4
        )
