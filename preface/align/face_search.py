"""The subject's face in one photograph: found in a small image, placed in crops of the full one.

The detector proposes squares; a face is what the landmark model sees there alike in several crops. Detectors
take faces that stand on their head for upright ones, and the landmark model then answers all the same: only
the agreement of its answers tells (seen: within 1.2% of the face's size where it is right, over 2% elsewhere).
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from preface.align.crops import Picture, Region, to_image
from preface.align.facemesh import REGION_OVER_BOX, FaceBox, FaceModels
from preface.align.keypoints import FACEMESH478
from preface.align.landmarks import NoFace, ViewLandmarks, box_around
from preface.align.visibility import facing, visibility

SETTLING = 3  # crops until the region follows from the landmarks themselves; more change nothing
# Crops that decide whether there is a face: shift along x and y and scale as parts of the region, turn.
PROBES = (((0.0, 0.0), 1.0, 0.0), ((0.05, 0.02), 1.1, 0.1), ((-0.04, -0.05), 0.95, -0.15))
# The probes' disagreement, as a part of the face's size: sure of a face, and the most for one.
SURE, TOLERATED = 0.012, 0.02
CONTRADICTORY = 0.03  # the same of the final crops, some of which are mirrored
QUARTERS = (0.0, np.pi, np.pi / 2, -np.pi / 2)
FINER = (np.pi / 6, -np.pi / 6, np.pi / 3, -np.pi / 3)
TILES = (2, 4)  # the image in tiles of a half and of a quarter of its longer side, overlapping by half
TILE_SIDE = 256  # pixels; the detectors see 128 and 192
REGION_OVER_DETECTION = 1.6  # FaceMesh's region against the detector's square
SAME_FACE = 0.5  # of the smaller side: faces whose centres are nearer than that are one
UPSIDE_DOWN = 135.0  # degrees
# Jitter of the crops at its extremes: shift as a part of the region, scale, turn. More than the regions of
# two photographs of one face differ, and less than what changes the mean.
SHIFT, SCALE, TURN = 0.05, 0.08, np.radians(10.0)
# The standard deviation of a coordinate, squared, in parts of the face's size:
# FLOOR² + (GAIN spread)² + (TURNED (1 - facing))². Fitted to how far landmarks of 8 synthetic heads in 88 views of a
# studio lie from the projection of the point that all views agree on. What FaceMesh gets wrong in all views alike, it
# cannot know: from the true points of the surface the same landmarks are about twice as far.
FLOOR, GAIN, TURNED = 0.002, 1.4, 0.01
# The spread of one crop cannot be seen; that of few is pulled to the usual one, with the weight of so many.
USUAL_SPREAD, USUAL_WEIGHT = 0.006, 2.0
DOUBTED = 0.02  # a spread, in parts of the face's size, that halves the confidence


@dataclass(frozen=True, eq=False)
class _Face:
    region: Region
    points: np.ndarray  # [478, 3] in the image
    disagreement: float


def find_landmarks(
    image: np.ndarray, models: FaceModels, scale: int, rotations: tuple[float, ...], jitters: int
) -> ViewLandmarks | NoFace:
    """Find the landmarks of the largest, most central face.

    Args:
        image: uint8 RGB [height, width, 3].
        models: of this process.
        scale: longer side in pixels of the image that the detector sees.
        rotations: degrees by which that image is turned, in this order, until a face is found.
        jitters: crops whose mean and spread are the result, at least 1.
    """
    picture = Picture(image)
    doubtful: list[FaceBox] = []
    for proposed in _proposals(picture, models, scale, rotations):
        boxes = [box for box in proposed if not any(_alike(box, other) for other in doubtful)]
        faces = _faces(picture, models, boxes)
        doubtful += boxes
        if faces:
            subject = max(faces, key=lambda face: _prominence(face, picture))
            return _landmarks(picture, models, subject, len(faces) - 1, jitters)
    where = f"at {len(rotations)} rotations and {1 + len(TILES)} scales"
    if doubtful:
        return NoFace(f"what looked like a face {where} gave no consistent landmarks (seen from the side?)")
    return NoFace(f"no face found {where}")


# ------------------------------------------------------------------------------------------- search


def _proposals(
    picture: Picture, models: FaceModels, scale: int, rotations: tuple[float, ...]
) -> Iterator[list[FaceBox]]:
    """Squares in the image's pixels: of the whole image turned in all ways, then of its tiles, upright."""
    size = np.array([picture.width, picture.height], float)
    whole = Region(size / 2, float(size.max()))
    side = min(scale, round(whole.side))
    for rotation in rotations:
        yield _detected(picture, models, [whole.moved(np.zeros(2), 1.0, np.radians(rotation), False)], side)
    for parts in TILES:
        tile = whole.side / parts
        counts = np.maximum(np.ceil(2 * size / tile - 1), 1).astype(int)
        centres = [
            (np.array([column, row]) + 1) * tile / 2
            for row in range(counts[1])
            for column in range(counts[0])
        ]
        regions = [Region(centre, tile) for centre in centres]
        yield _detected(picture, models, regions, min(TILE_SIDE, scale, max(1, round(tile))))


def _detected(picture: Picture, models: FaceModels, regions: list[Region], side: int) -> list[FaceBox]:
    found = []
    for region in regions:
        for box in models.faces(picture.crop(region, side)):
            centre = to_image(box.centre[None], region, side)[0]
            found.append(FaceBox(centre, box.side * region.side / side, box.roll + region.roll, box.score))
    distinct: list[FaceBox] = []
    for box in sorted(found, key=lambda box: -box.score):
        if not any(_same(box.centre, box.side, other.centre, other.side) for other in distinct):
            distinct.append(box)
    return distinct


def _same(centre: np.ndarray, side: float, other_centre: np.ndarray, other_side: float) -> bool:
    return float(np.linalg.norm(centre - other_centre)) < SAME_FACE * min(side, other_side)


def _alike(box: FaceBox, other: FaceBox) -> bool:
    """Whether a proposal is one that was tried in all turns before."""
    near = float(np.linalg.norm(box.centre - other.centre)) < 0.2 * other.side
    return near and 0.8 < box.side / other.side < 1.25


def _faces(picture: Picture, models: FaceModels, boxes: list[FaceBox]) -> list[_Face]:
    """The proposals that are faces, each once."""
    faces: list[_Face] = []
    for box in boxes:
        face = _confirmed(picture, models, box)
        if face is not None and not any(
            _same(face.region.centre, face.region.side, other.region.centre, other.region.side)
            for other in faces
        ):
            faces.append(face)
    return faces


def _confirmed(picture: Picture, models: FaceModels, box: FaceBox) -> _Face | None:
    """The face in a proposed square, in whichever way it is turned."""
    best: _Face | None = None
    start = Region(box.centre, REGION_OVER_DETECTION * box.side, box.roll)
    for turns in (QUARTERS, FINER):
        for turn in turns:
            face = _probed(picture, models, start.moved(np.zeros(2), 1.0, turn, False))
            if face is not None and (best is None or face.disagreement < best.disagreement):
                best = face
            if best is not None and best.disagreement < SURE:
                return best
        if best is not None and best.disagreement < TOLERATED:
            return best
    return None


def _probed(picture: Picture, models: FaceModels, region: Region) -> _Face | None:
    for _ in range(SETTLING):
        points = _observe(picture, models, region)
        if points is None:
            return None
        region = _region_of(points)
    several = [
        _observe(picture, models, region.moved(np.array(shift), scale, turn, False))
        for shift, scale, turn in PROBES
    ]
    seen = np.array([points for points in several if points is not None])
    if len(seen) < len(PROBES):
        return None
    spread = np.median(np.linalg.norm(seen[..., :2].std(0), axis=-1))
    return _Face(region, seen.mean(0), float(spread) * REGION_OVER_BOX / region.side)


def _region_of(points: np.ndarray) -> Region:
    right, left = FACEMESH478.keypoint_pixels(points[:, :2])[:2]
    return Region.around(points[:, :2], float(np.arctan2(*(left - right)[::-1])), REGION_OVER_BOX)


def _observe(picture: Picture, models: FaceModels, region: Region) -> np.ndarray | None:
    """Landmarks [478, 3] in the image's pixels, of one crop."""
    side = models.model.crop_side
    points = models.model.landmarks(picture.crop(region, side))
    if points is None:
        return None
    points = to_image(points, region, side)
    return points[FACEMESH478.mirror] if region.mirrored else points


def _prominence(face: _Face, picture: Picture) -> float:
    """The size of a face, halved when it lies at the corner of the image."""
    middle = np.array([picture.width, picture.height]) / 2
    off_centre = float(np.linalg.norm(face.region.centre - middle) / np.linalg.norm(middle))
    return face.region.side * (1 - 0.5 * min(off_centre, 1.0))


# ----------------------------------------------------------------------------------------- landmarks


def _landmarks(
    picture: Picture, models: FaceModels, face: _Face, others: int, jitters: int
) -> ViewLandmarks | NoFace:
    crops = [face.region.moved(*jitter) for jitter in _jitter(jitters)]
    several = [_observe(picture, models, region) for region in crops]
    seen = np.array([points for points in several if points is not None])
    if not len(seen):
        seen = face.points[None]
    points = seen.mean(0)
    size = face.region.side / REGION_OVER_BOX
    variance = ((seen[..., :2] - points[:, :2]) ** 2).mean(-1).sum(0) / size**2
    if np.sqrt(np.median(variance) / max(len(seen) - 1, 1)) > CONTRADICTORY:
        return NoFace("crops that differ a little, or are mirrored, give contradictory landmarks")
    spread = np.sqrt((variance + USUAL_WEIGHT * USUAL_SPREAD**2) / (len(seen) - 1 + USUAL_WEIGHT))
    turned = 1 - facing(points)
    sigma = size * np.sqrt(FLOOR**2 + (GAIN * spread) ** 2 + (TURNED * turned) ** 2)
    pixels = points[:, :2]
    inside = ((pixels >= 0) & (pixels <= [picture.width, picture.height])).all(-1)
    confidence = visibility(points) / (1 + (spread / DOUBTED) ** 2)
    pixels = np.where(inside[:, None], pixels, np.nan)
    roll = float(np.degrees(_region_of(points).roll))
    return ViewLandmarks(
        scheme=FACEMESH478.name,
        pixels=pixels,
        sigma=np.where(inside, sigma, np.nan),
        confidence=np.where(inside, confidence, 0.0),
        face_box=box_around(pixels),
        rotation=roll,
        others=others,
        warnings=tuple(_warnings(face, others, roll, int((~inside).sum()), len(seen), jitters)),
    )


def _jitter(count: int) -> list[tuple[np.ndarray, float, float, bool]]:
    """Deterministic, evenly spread jitters of a region, every second in a mirror; a single one is none.

    The additive recurrence of Roberts (2018), "The unreasonable effectiveness of quasirandom sequences".
    """
    if count == 1:
        return [(np.zeros(2), 1.0, 0.0, False)]
    root = 1.1673039782614187  # of x^5 = x + 1, for four dimensions
    steps = root ** -np.arange(1.0, 5.0)
    evenly = 2 * ((0.5 + np.arange(1, count + 1)[:, None] * steps) % 1) - 1
    evenly -= evenly.mean(0)
    return [
        (SHIFT * row[:2], 1 + SCALE * float(row[2]), TURN * float(row[3]), bool(index % 2))
        for index, row in enumerate(evenly)
    ]


def _warnings(face: _Face, others: int, roll: float, outside: int, seen: int, jitters: int) -> Iterator[str]:
    x, y = face.region.centre
    if others:
        faces = f"{others} other face{'s are' if others > 1 else ' is'}"
        yield f"{faces} in the image; the largest, most central one at ({x:.0f}, {y:.0f}) is taken."
    if abs(roll) > UPSIDE_DOWN:
        yield f"The face stands on its head (turned by {roll:.0f} degrees): is the image upside down?"
    if outside:
        yield f"{outside} of {FACEMESH478.size} landmarks lie outside the image and count as not seen."
    if seen < jitters:
        yield f"Only {seen} of {jitters} crops show a face to the landmark model."
