"""All takes of a capture, one rig each, and what moved between them.

The cameras are the same in every take, so that the camera model and the board's shape are chosen once, on the
take with the most sightings, and then hold for all; parameters and poses are each take's own, and each take
begins with the lenses of its neighbour.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.spatial.transform import Rotation

from preface.capture.calibration import Calibration, CalibrationError, CalibrationOptions, calibrate_rig
from preface.capture.observations import Observations
from preface.geometry.cameras import Camera
from preface.geometry.similarity import fit_similarity
from preface.geometry.transforms import Rigid
from preface.plain_words import suggestion

HEAD_RADIUS = 0.09  # metres; eyes, ears and chin lie about this far from the middle of a head
# A measured distance between cameras may be off by this share: tapes sag, and a lens's centre is not marked.
DISTANCE_TOLERANCE = 0.02
# The five keypoints of an average head about its middle, metres: x to the head's left, y up, z out of the face.
KEYPOINTS: Mapping[str, tuple[float, float, float]] = {
    "right_eye_outer": (-0.045, 0.03, 0.0),
    "left_eye_outer": (0.045, 0.03, 0.0),
    "nose_tip": (0.0, -0.01, 0.04),
    "mouth_center": (0.0, -0.045, 0.02),
    "chin": (0.0, -0.085, 0.0),
}


@dataclass(frozen=True)
class CameraDrift:
    """How one camera differs between two takes, after the takes' rigs were laid onto each other.

    Attributes:
        camera: its name.
        center: how far its centre moved, metres.
        center_deviation: one standard deviation that the two calibrations predict for that, metres.
        rotation: how far it turned, radians.
        focal: relative change of the focal length.
        pixels: by how much points of a head would move in its image (root mean square).
    """

    camera: str
    center: float
    center_deviation: float
    rotation: float
    focal: float
    pixels: float


def calibrate_takes(takes: Mapping[str, Observations], options: CalibrationOptions) -> dict[str, Calibration]:
    """Calibrate every take, from the one with the most sightings to its neighbours and on.

    Args:
        takes: sightings by take, in the order in which the takes were recorded.
        options: for all of them; what they leave to held-out frames is settled by the first take calibrated.

    Returns:
        A calibration per take, in the order given.

    Raises:
        CalibrationError: as `calibrate_rig`; with several takes the message names the take first.
    """
    names = list(takes)
    first = max(range(len(names)), key=lambda index: len(takes[names[index]]))
    found: dict[str, Calibration] = {}
    for index in sorted(range(len(names)), key=lambda index: abs(index - first)):
        name = names[index]
        try:
            neighbour = names[index + np.sign(first - index)]
            found[name] = calibrate_rig(takes[name], options, found.get(neighbour))
        except CalibrationError as error:
            raise CalibrationError(f"take '{name}': {error}" if len(names) > 1 else str(error)) from error
        options = settled(options, found[name])
    return {name: found[name] for name in names}


def settled(options: CalibrationOptions, calibration: Calibration) -> CalibrationOptions:
    """The options with what they leave to held-out frames as a calibration chose it."""
    chosen = next((candidate for candidate in calibration.selection if candidate.chosen), None)
    if chosen is None:
        return options
    warp = "on" if chosen.board_warp else "off"
    return replace(options, camera_model=chosen.camera_model, board_warp=warp)  # type: ignore[arg-type]


def drift(before: Calibration, after: Calibration) -> list[CameraDrift]:
    """Compare the cameras that two takes share.

    Each calibration's frame is its first camera's. The second rig is laid onto the first where it matters: by
    the rigid motion after which both agree best on where the points of a head are, given their images.
    """
    names = [name for name in before.observations.camera_ids if name in after.observations.camera_ids]
    pairs = [(_view(before, name), _view(after, name)) for name in names]
    if not pairs:
        return []
    around = middle_of_boards(before) + HEAD_RADIUS * np.array(list(product((-1.0, 0.0, 1.0), repeat=3)))
    images = [old.camera.project(old.pose.apply(around)) for old, _ in pairs]
    second_from_first = _laid_onto(pairs, around, images)
    drifts = []
    for name, (old, new), (pixels, seen) in zip(names, pairs, images, strict=True):
        pose = new.pose @ second_from_first
        moved, still_seen = new.camera.project(pose.apply(around))
        shift = np.linalg.norm(moved - pixels, axis=-1)[seen & still_seen]
        drifts.append(
            CameraDrift(
                camera=name,
                center=float(np.linalg.norm(pose.inverse.translation - old.pose.inverse.translation)),
                center_deviation=float(np.sqrt(old.center_variance + new.center_variance)),
                rotation=float(Rotation.from_matrix(pose.rotation @ old.pose.rotation.T).magnitude()),
                focal=float(new.camera.intrinsics[0] / old.camera.intrinsics[0] - 1),
                pixels=float(np.sqrt((shift**2).mean())) if shift.size else float("nan"),
            )
        )
    return drifts


@dataclass(frozen=True)
class _View:
    """One camera of a calibration; the variance of its centre's distance is free of the gauge, metres²."""

    camera: Camera
    pose: Rigid
    center_variance: float


def _view(calibration: Calibration, name: str) -> _View:
    index = calibration.observations.camera_ids.index(name)
    poses = calibration.camera_from_rig
    covariance = calibration.uncertainty.under("boards").centers()[index]
    pose = Rigid(poses.rotation[index], poses.translation[index])
    return _View(calibration.cameras[index], pose, float(np.trace(covariance)))


def _laid_onto(
    pairs: list[tuple[_View, _View]], points: np.ndarray, images: list[tuple[np.ndarray, np.ndarray]]
) -> Rigid:
    """second_from_first, from points [N, 3] of the first rig's frame and their images in its cameras.

    The second rig's rays through the same pixels meet (in the least-squares sense) where it has the points.
    """
    normal, right, count = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3)), np.zeros(len(points))
    for (_, new), (pixels, seen) in zip(pairs, images, strict=True):
        normalised, valid = new.camera.unproject(pixels)
        rays = np.concatenate([normalised, np.ones((len(points), 1))], axis=1) @ new.pose.rotation
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
        used = seen & valid
        normal[used] += across[used]
        right[used] += (across @ new.pose.inverse.translation)[used]
        count += used
    met = count >= 2
    if met.sum() < 4:  # one camera, or fields of view that hardly overlap: let the first shared camera rest
        old, new = pairs[0]
        return new.pose.inverse @ old.pose
    found = np.linalg.solve(normal[met], right[met][..., None])[..., 0]
    fit = fit_similarity(points[met], found, fixed_scale=1.0).target_from_source
    return Rigid(fit.rotation, fit.translation)


def require_distance(calibration: Calibration, first: str, second: str, metres: float) -> None:
    """Hold the rig's scale, which comes from the board's square size alone, against a measured distance.

    Raises:
        CalibrationError: no such cameras, or the rig has them at another distance.
    """
    names = calibration.observations.camera_ids
    for name in (first, second):
        if name not in names:
            raise CalibrationError(f"known_distance: there is no camera '{name}'; {suggestion(name, names)}")
    if first == second or not 0 < metres < np.inf:
        raise CalibrationError(
            f"known_distance: {metres} m from '{first}' to '{second}' is no distance between two cameras; "
            "give two cameras and a positive number of metres"
        )
    centers = calibration.camera_from_rig.inverse.translation
    found = float(np.linalg.norm(centers[names.index(first)] - centers[names.index(second)]))
    deviation = np.sqrt(sum(_view(calibration, name).center_variance for name in (first, second)))
    if abs(found - metres) > DISTANCE_TOLERANCE * metres + 3 * deviation:
        raise CalibrationError(
            f"known_distance: '{first}' and '{second}' are {found:.4f} m apart in the rig, but {metres:g} m were "
            f"measured; the board's square size would have to be {metres / found:.4f} times what was given. "
            "Measure the square, or the distance, again"
        )


def without_cameras(observations: Observations, names: Sequence[str]) -> Observations:
    """The sightings of all other cameras; frames and board points stay."""
    keep = [index for index, name in enumerate(observations.camera_ids) if name not in names]
    place = np.full(len(observations.camera_ids), -1)
    place[keep] = np.arange(len(keep))
    kept = observations.subset(place[observations.camera] >= 0)
    return replace(
        kept,
        camera_ids=tuple(observations.camera_ids[index] for index in keep),
        image_sizes=tuple(observations.image_sizes[index] for index in keep),
        camera=place[kept.camera],
    )


def middle_of_boards(calibration: Calibration) -> np.ndarray:
    """Where the boards were held [3], rig frame, metres: the median of their middles, where a head will be."""
    return np.median(board_outlines(calibration).mean(axis=1), axis=0)


def board_outlines(calibration: Calibration) -> np.ndarray:
    """Corners [F, 4, 3] of the board's point area in every frame that was solved, rig frame, metres."""
    points = calibration.observations.board_points
    (left, top), (right, bottom) = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    corners = np.array([(left, top, 0), (right, top, 0), (right, bottom, 0), (left, bottom, 0)])
    return np.stack([pose.apply(corners) for pose in calibration.rig_from_board.values()])


def keypoints_between(calibration: Calibration) -> np.ndarray:
    """Five keypoints [5, 3] of an average head, rig frame, in the middle of the boards, facing the cameras."""
    middle = middle_of_boards(calibration)
    pose = calibration.camera_from_rig
    up = -pose.rotation[:, 1].mean(axis=0)
    towards = pose.inverse.translation - middle
    out = (towards / np.linalg.norm(towards, axis=-1, keepdims=True)).mean(axis=0)
    if np.linalg.norm(out) < 1e-3:  # cameras all around: it faces the first
        out = towards[0]
    out = out / np.linalg.norm(out)
    left = np.cross(up, out)
    left = left / np.linalg.norm(left)
    rig_from_head = np.stack([left, np.cross(out, left), out], axis=1)
    return middle + np.array(list(KEYPOINTS.values())) @ rig_from_head.T
