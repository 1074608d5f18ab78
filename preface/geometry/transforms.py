"""Rigid motions and similarities, in float64, named `target_from_source`; matrices act on column vectors.

Leading dimensions are a batch: `apply` broadcasts them against those of the points.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import overload

import numpy as np
from scipy.spatial.transform import Rotation

from preface.geometry.arrays import rotate
from preface.geometry.errors import GeometryError

# A quaternion is normalised on the way in; a length further off is no unit quaternion at all.
QUATERNION_TOLERANCE = 1e-3
# Largest entry of R^T R - I that is still a rotation written with few digits. At a focal length of
# 10,000 px it moves a point by 0.01 px.
ORTHOGONALITY_TOLERANCE = 1e-6


@dataclass(frozen=True, eq=False)
class Rigid:
    """target = rotation @ source + translation.

    Attributes:
        rotation: [..., 3, 3].
        translation: [..., 3], metres.

    Raises:
        GeometryError: the rotation is none, or a number is not finite.
    """

    rotation: np.ndarray
    translation: np.ndarray

    def __post_init__(self) -> None:
        object.__setattr__(self, "rotation", validate_rotation(self.rotation))
        object.__setattr__(self, "translation", _vector(self.translation, "translation", (3,)))

    @staticmethod
    def identity() -> Rigid:
        """Return the motion that moves nothing."""
        return Rigid(np.eye(3), np.zeros(3))

    @staticmethod
    def from_quaternion(quaternion_wxyz: np.ndarray, translation: np.ndarray) -> Rigid:
        """Build from unit quaternions [..., 4], scalar first, and translations [..., 3]."""
        return Rigid(rotation_from_quaternion(quaternion_wxyz), translation)

    @staticmethod
    def from_matrix(matrix: np.ndarray) -> Rigid:
        """Build from matrices [..., 4, 4] or [..., 3, 4]."""
        matrix = _affine(matrix)
        return Rigid(matrix[..., :3, :3], matrix[..., :3, 3])

    @property
    def quaternion_wxyz(self) -> np.ndarray:
        """Unit quaternions [..., 4], scalar first and not negative."""
        return quaternion_from_rotation(self.rotation)

    @property
    def matrix(self) -> np.ndarray:
        """Homogeneous matrices [..., 4, 4]."""
        return _homogeneous(self.rotation, self.translation)

    @property
    def inverse(self) -> Rigid:
        """source_from_target."""
        inverse = np.swapaxes(self.rotation, -1, -2)
        return Rigid(inverse, -rotate(inverse, self.translation))

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Move points [..., 3]."""
        return rotate(self.rotation, np.asarray(points, dtype=np.float64)) + self.translation

    @overload
    def __matmul__(self, other: Rigid) -> Rigid: ...
    @overload
    def __matmul__(self, other: Similarity) -> Similarity: ...
    def __matmul__(self, other: Rigid | Similarity) -> Rigid | Similarity:
        """a_from_b @ b_from_c = a_from_c."""
        rotation, translation = self.rotation @ other.rotation, self.apply(other.translation)
        if isinstance(other, Similarity):
            return Similarity(other.scale, rotation, translation)
        return Rigid(rotation, translation)


@dataclass(frozen=True, eq=False)
class Similarity:
    """target = scale * rotation @ source + translation.

    Attributes:
        scale: [...], positive.
        rotation: [..., 3, 3].
        translation: [..., 3], units of the target.

    Raises:
        GeometryError: the rotation is none, the scale is not positive, or a number is not finite.
    """

    scale: np.ndarray
    rotation: np.ndarray
    translation: np.ndarray

    def __post_init__(self) -> None:
        scale = _vector(self.scale, "scale", ())
        if not (scale > 0).all():
            raise GeometryError(
                f"scale: {scale.min()} is not positive; a mirrored or collapsed frame is no similarity"
            )
        object.__setattr__(self, "scale", scale)
        object.__setattr__(self, "rotation", validate_rotation(self.rotation))
        object.__setattr__(self, "translation", _vector(self.translation, "translation", (3,)))

    @staticmethod
    def from_quaternion(
        scale: np.ndarray, quaternion_wxyz: np.ndarray, translation: np.ndarray
    ) -> Similarity:
        """Build from scales [...], unit quaternions [..., 4], scalar first, and translations [..., 3]."""
        return Similarity(scale, rotation_from_quaternion(quaternion_wxyz), translation)

    @staticmethod
    def from_matrix(matrix: np.ndarray) -> Similarity:
        """Build from matrices [..., 4, 4] or [..., 3, 4] whose left block is a rotation times a scale."""
        matrix = _affine(matrix)
        determinant = np.linalg.det(matrix[..., :3, :3])
        if not (determinant > 0).all():
            raise GeometryError(
                f"matrix: the determinant {determinant.min():.6g} of its left block is not positive; "
                "an axis is mirrored or lost: negate it, or exchange the two that are swapped"
            )
        scale = np.cbrt(determinant)
        return Similarity(scale, matrix[..., :3, :3] / scale[..., None, None], matrix[..., :3, 3])

    @property
    def quaternion_wxyz(self) -> np.ndarray:
        """Unit quaternions [..., 4], scalar first and not negative."""
        return quaternion_from_rotation(self.rotation)

    @property
    def matrix(self) -> np.ndarray:
        """Homogeneous matrices [..., 4, 4]."""
        return _homogeneous(self.scale[..., None, None] * self.rotation, self.translation)

    @property
    def inverse(self) -> Similarity:
        """source_from_target."""
        inverse = np.swapaxes(self.rotation, -1, -2)
        return Similarity(1 / self.scale, inverse, -rotate(inverse, self.translation) / self.scale[..., None])

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Map points [..., 3]."""
        rotated = rotate(self.rotation, np.asarray(points, dtype=np.float64))
        return self.scale[..., None] * rotated + self.translation

    def apply_to_pose(self, source_from_camera: Rigid) -> Rigid:
        """Carry a camera along: its centre is mapped, its axes are turned but not stretched.

        Returns:
            target_from_camera, which sees the mapped scene exactly as the camera saw the scene.
        """
        return Rigid(self.rotation @ source_from_camera.rotation, self.apply(source_from_camera.translation))

    def __matmul__(self, other: Rigid | Similarity) -> Similarity:
        """a_from_b @ b_from_c = a_from_c."""
        scale = self.scale * other.scale if isinstance(other, Similarity) else self.scale
        return Similarity(scale, self.rotation @ other.rotation, self.apply(other.translation))


def validate_rotation(rotation: np.ndarray, name: str = "rotation") -> np.ndarray:
    """Return rotations [..., 3, 3] as float64, or raise GeometryError saying what they are instead."""
    rotation = _vector(rotation, name, (3, 3))
    defect = np.abs(np.swapaxes(rotation, -1, -2) @ rotation - np.eye(3)).max(axis=(-1, -2), initial=0)
    determinant = np.linalg.det(rotation)
    wrong = (defect > ORTHOGONALITY_TOLERANCE) | (determinant <= 0)
    if not wrong.any():
        return rotation
    first = tuple(int(i) for i in np.argwhere(wrong)[0])
    where = f"{name}[{', '.join(map(str, first))}]" if first else name
    if determinant[first] <= 0:
        remedy = "an axis is mirrored or lost: negate it, or exchange the two that are swapped"
    elif defect[first] < 1e-3:
        remedy = "it was written with too few digits: pass it through nearest_rotation"
    else:
        remedy = "a scaled rotation is a Similarity; check also that rows and columns are complete"
    raise GeometryError(
        f"{where}: not a rotation matrix: determinant {determinant[first]:.6g} (must be 1), "
        f"orthogonality defect {defect[first]:.3g} (must be below {ORTHOGONALITY_TOLERANCE:g}); {remedy}"
    )


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """Return the rotation nearest to each matrix [..., 3, 3] in the Frobenius norm (Umeyama 1991, eq. 40)."""
    u, _, vt = np.linalg.svd(_vector(matrix, "matrix", (3, 3)))
    u[..., :, 2] *= np.sign(np.linalg.det(u) * np.linalg.det(vt))[..., None]
    return u @ vt


def rotation_from_quaternion(quaternion_wxyz: np.ndarray) -> np.ndarray:
    """Turn unit quaternions [..., 4], scalar first, into matrices [..., 3, 3].

    Raises:
        GeometryError: a quaternion is not finite or its length is off by more than 0.001.
    """
    quaternion = _vector(quaternion_wxyz, "quaternion_wxyz", (4,))
    length = np.linalg.norm(quaternion, axis=-1)
    if (np.abs(length - 1) > QUATERNION_TOLERANCE).any():
        worst = length.flat[np.abs(length - 1).argmax()]
        raise GeometryError(f"quaternion_wxyz: its length is {worst:.6g}, not 1; divide it by its length")
    flat = Rotation.from_quat(quaternion.reshape(-1, 4), scalar_first=True).as_matrix()
    return flat.reshape(*quaternion.shape[:-1], 3, 3)


def quaternion_from_rotation(rotation: np.ndarray) -> np.ndarray:
    """Turn matrices [..., 3, 3] into unit quaternions [..., 4], scalar first and not negative."""
    rotation = validate_rotation(rotation)
    flat = Rotation.from_matrix(rotation.reshape(-1, 3, 3)).as_quat(canonical=True, scalar_first=True)
    return flat.reshape(*rotation.shape[:-2], 4)


def _vector(values: np.ndarray, name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Return finite float64 values [..., *shape], or raise GeometryError."""
    try:
        values = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise GeometryError(f"{name}: not an array of numbers; give {('...', *shape)}") from error
    if values.shape[values.ndim - len(shape) :] != shape or values.ndim < len(shape):
        raise GeometryError(f"{name}: its shape {values.shape} does not end in {shape}")
    if not np.isfinite(values).all():
        raise GeometryError(f"{name}: {np.argwhere(~np.isfinite(values))[0].tolist()} is not finite")
    return values


def _affine(matrix: np.ndarray) -> np.ndarray:
    """Return matrices [..., 3 or 4, 4] as float64 after checking the bottom row."""
    matrix = np.asarray(matrix, dtype=np.float64)
    if matrix.shape[-2:] not in ((3, 4), (4, 4)):
        raise GeometryError(f"matrix: its shape {matrix.shape} does not end in (4, 4) or (3, 4)")
    if matrix.shape[-2] == 4 and not np.allclose(matrix[..., 3, :], (0, 0, 0, 1), rtol=0, atol=1e-9):
        raise GeometryError("matrix: its last row is not (0, 0, 0, 1); is it transposed?")
    return matrix


def _homogeneous(linear: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Stack linear parts [..., 3, 3] and translations [..., 3] into [..., 4, 4]."""
    batch = np.broadcast_shapes(linear.shape[:-2], translation.shape[:-1])
    matrix = np.zeros((*batch, 4, 4))
    matrix[..., :3, :3], matrix[..., :3, 3], matrix[..., 3, 3] = linear, translation, 1
    return matrix
