"""How well the sightings determine the lenses: standard deviations, with poses and points unknown too."""

import numpy as np
from scipy import linalg, sparse

from preface.capture.photos.adjustment import Refine
from preface.capture.photos.structure import Structure, Tracks
from preface.geometry.cameras import CAMERA_MODELS

# Distances whose two coordinates have a standard deviation of 1 each have this median (Rayleigh).
_RAYLEIGH_MEDIAN = np.sqrt(2 * np.log(2))


def lens_deviations(structure: Structure, tracks: Tracks, refine: Refine) -> list[np.ndarray]:
    """Standard deviations of every camera's parameters at the minimum of an adjustment.

    First order: the inverse of the reduced normal equations, times the noise that the median residual
    shows. Gauge: the first photograph and one coordinate of the farthest one are held; the lenses'
    deviations do not depend on that choice.

    Args:
        structure: the minimum.
        tracks: the sightings that were adjusted.
        refine: what was free.

    Returns:
        For each camera an array in the order of its params: 0 for what was held, inf for all that was free
        where the sightings leave something undetermined.
    """
    if not refine.lens:
        return [np.zeros(len(camera.params)) for camera in structure.cameras]
    errors = structure.reprojection_errors(tracks)
    tracks = tracks.subset(np.isfinite(errors))  # a point behind a camera has no derivatives
    free = [_free_params(camera.model, refine) for camera in structure.cameras]
    by_lens, by_pose, by_point = _jacobians(structure, tracks, free)
    keep = _ungauged(structure)
    reduced = _reduced_normal_matrix(sparse.hstack([by_lens, by_pose[:, keep]], "csr"), by_point, tracks)
    noise = np.median(errors) / _RAYLEIGH_MEDIAN
    size = by_lens.shape[1]
    variances = np.full(size, np.inf)
    # Columns differ by orders of magnitude (pixels, radians, lengths): equilibrate before factorising.
    scale = np.sqrt(np.diag(reduced))
    if np.all(scale > 0):
        try:
            factor = linalg.cho_factor(reduced / np.outer(scale, scale))
            inverse = linalg.cho_solve(factor, np.eye(len(reduced))[:, :size])
            variances = np.diag(inverse[:size]) / scale[:size] ** 2
        except linalg.LinAlgError:
            pass  # singular: undetermined, which inf says
    result, start = [], 0
    for camera, columns in zip(structure.cameras, free, strict=True):
        deviations = np.zeros(len(camera.params))
        deviations[columns] = noise * np.sqrt(variances[start : start + len(columns)])
        start += len(columns)
        result.append(deviations)
    return result


def _free_params(model: str, refine: Refine) -> list[int]:
    names = CAMERA_MODELS[model]
    return [i for i, name in enumerate(names) if refine.principal_point or name not in ("cx", "cy")]


def _jacobians(
    structure: Structure, tracks: Tracks, free: list[list[int]]
) -> tuple[sparse.csr_matrix, sparse.csr_matrix, np.ndarray]:
    """d_pixels by free lens parameters [2M, n] and by poses [2M, 6N] (sparse), by points [M, 2, 3].

    A pose's six: a rotation vector about the camera's axes, then the translation.
    """
    in_camera = structure.in_cameras(tracks)
    camera_of = tracks.camera_of_image[tracks.image]
    by_camera_point = np.full((len(tracks), 2, 3), np.nan)
    starts = np.cumsum([0, *map(len, free)])
    rows, columns, values = [], [], []
    for index, camera in enumerate(structure.cameras):
        mine = np.flatnonzero(camera_of == index)
        by_camera_point[mine], by_params = camera.projection_jacobians(in_camera[mine])
        for slot, param in enumerate(free[index]):
            rows.append((2 * mine[:, None] + [0, 1]).ravel())
            columns.append(np.full(2 * len(mine), starts[index] + slot))
            values.append(by_params[..., param].ravel())
    shape = (2 * len(tracks), int(starts[-1]))
    by_lens = sparse.csr_matrix(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape
    )
    # A small rotation w moves the camera-frame point x by w × x: minus the cross-product matrix of x.
    x, y, z = np.moveaxis(in_camera, -1, 0)
    zero = np.zeros_like(x)
    turn = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], axis=-1).reshape(-1, 3, 3)
    by_pose = np.concatenate([by_camera_point @ turn, by_camera_point], axis=-1)
    pose_columns = np.broadcast_to((6 * tracks.image[:, None] + np.arange(6))[:, None], by_pose.shape)
    pose_rows = np.broadcast_to(np.arange(2 * len(tracks)).reshape(-1, 2, 1), by_pose.shape)
    sparse_pose = sparse.csr_matrix(
        (by_pose.ravel(), (pose_rows.ravel(), pose_columns.ravel())),
        (2 * len(tracks), 6 * len(tracks.camera_of_image)),
    )
    return by_lens, sparse_pose, by_camera_point @ structure.camera_from_world.rotation[tracks.image]


def _ungauged(structure: Structure) -> np.ndarray:
    """Columns of the poses that remain when the first one and the longest baseline are held."""
    pose = structure.camera_from_world
    first = structure.in_frame_of_image(0, 1.0).camera_from_world.translation
    farthest = int(np.argmax(np.linalg.norm(first, axis=1)))
    held = 6 * farthest + 3 + int(np.argmax(np.abs(first[farthest])))
    return np.setdiff1d(np.arange(6, 6 * len(pose.translation)), [held])


def _reduced_normal_matrix(by_cameras: sparse.csr_matrix, by_point: np.ndarray, tracks: Tracks) -> np.ndarray:
    """Normal matrix of lenses and poses with the points eliminated (Schur complement), dense."""
    count = int(tracks.point.max()) + 1
    point_blocks = np.zeros((count, 3, 3))
    np.add.at(point_blocks, tracks.point, np.einsum("mki,mkj->mij", by_point, by_point))
    seen = np.unique(tracks.point)
    inverse = np.zeros_like(point_blocks)
    inverse[seen] = np.linalg.pinv(point_blocks[seen], hermitian=True)  # of two equal rays: singular
    columns = np.broadcast_to((3 * tracks.point[:, None] + np.arange(3))[:, None], by_point.shape)
    rows = np.broadcast_to(np.arange(2 * len(tracks)).reshape(-1, 2, 1), by_point.shape)
    points = sparse.csr_matrix(
        (by_point.ravel(), (rows.ravel(), columns.ravel())), (2 * len(tracks), 3 * count)
    )
    middle = sparse.bsr_matrix((inverse, np.arange(count), np.arange(count + 1)))
    coupling = by_cameras.T @ points
    return (by_cameras.T @ by_cameras - coupling @ middle @ coupling.T).toarray()
