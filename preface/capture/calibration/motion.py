"""Cameras that do not take a frame at the same instant: the board has moved from one view to the next.

Each view then has a pose of its own, near its frame's: P_view = M P_frame, where M turns the board about its
middle by w and shifts it by d, both random and independent of direction (random effects, as in Pinheiro, Liu
and Wu, "Efficient algorithms for robust estimation in linear mixed-effects models using the multivariate t
distribution", 2001). What a view says about lens and board by its shape then counts in full, and where it has
the board counts as far as motion allows. The six numbers of each view leave the normal equations first, by the
Schur complement.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from preface.capture.calibration.views import BoardViews
from preface.geometry.transforms import Rigid

# Degrees of freedom of the t distribution: boards rest in some frames and are waved in others.
FREEDOM = 4.0


@dataclass(frozen=True, eq=False)
class Motion:
    """How the board moves within frames.

    Attributes:
        rotation: [C, F, 3, 3], its turn in each view about its middle, along the camera's axes.
        translation: [C, F, 3] metres, its shift there.
        deviations: [6], scale of turn (radians) and shift (metres), three times each.
        information: [C, F, 6], the pixel noise's variance over that of turn and shift, pixels²/unit².
    """

    rotation: np.ndarray
    translation: np.ndarray
    deviations: np.ndarray
    information: np.ndarray

    @staticmethod
    def between(views: BoardViews, at_rest: Rigid, seen: Rigid) -> Motion:
        """The motion from the poses [V] that frames give the board to those that views have it in; unweighed."""
        rotation = np.tile(np.eye(3), (views.cameras, views.frames, 1, 1))
        translation = np.zeros((views.cameras, views.frames, 3))
        where = views.camera, views.frame
        rotation[where] = seen.rotation @ np.swapaxes(at_rest.rotation, -1, -2)
        translation[where] = seen.translation - at_rest.translation
        shape = (views.cameras, views.frames, 6)
        return Motion(rotation, translation, np.full(6, np.inf), np.zeros(shape))

    def turns(self, views: BoardViews) -> np.ndarray:
        """Rotation matrices [V, 3, 3]."""
        return self.rotation[views.camera, views.frame]

    def steps(self, views: BoardViews) -> np.ndarray:
        """Turn (rotation vector) and shift in each view, [V, 6]."""
        turn = Rotation.from_matrix(self.turns(views)).as_rotvec()
        return np.concatenate([turn, self.translation[views.camera, views.frame]], axis=-1)

    def weights(self, views: BoardViews) -> np.ndarray:
        """Information of the views, [V, 6]."""
        return self.information[views.camera, views.frame]

    def weighed(self, views: BoardViews, near: np.ndarray, sigma: float) -> Motion:
        """Estimate the deviations, and weigh each view, under a multivariate t distribution; one round of it.

        Args:
            views: all views.
            near: [V], those to judge by.
            sigma: standard deviation of the pixel noise.
        """
        steps = self.steps(views)
        count = np.bincount(views.frame[near], minlength=views.frames)[views.frame]
        # A frame's own pose takes the mean of its views' motion away; alone in a frame, a view shows none.
        spare = near * (1 - 1 / np.maximum(count, 1))
        squared = steps**2
        weight = (FREEDOM + 6) / (FREEDOM + (squared / self.deviations**2).sum(axis=1))
        total = (weight * near) @ squared / spare.sum()
        deviations = np.sqrt(np.repeat(total.reshape(2, 3).mean(axis=1), 3))
        information = self.information.copy()
        weight = (FREEDOM + 6) / (FREEDOM + (squared / deviations**2).sum(axis=1))
        information[views.camera, views.frame] = weight[:, None] * (sigma / deviations) ** 2
        return replace(self, deviations=deviations, information=information)

    def lengths(self, views: BoardViews) -> np.ndarray:
        """Turn and shift in each view together, in deviations, [V]."""
        return np.linalg.norm(self.steps(views) / self.deviations, axis=1)

    def apply(self, views: BoardViews, at_rest: Rigid) -> Rigid:
        """Poses [V] of the board in each view, from those that its frame gives it."""
        where = views.camera, views.frame
        return Rigid(self.turns(views) @ at_rest.rotation, at_rest.translation + self.translation[where])

    def moved(self, views: BoardViews, step: np.ndarray) -> Motion:
        """Take a step [V, 6]."""
        rotation, translation = self.rotation.copy(), self.translation.copy()
        where = views.camera, views.frame
        poses = turned(Rigid(rotation[where], translation[where]), step)
        rotation[where], translation[where] = poses.rotation, poses.translation
        return replace(self, rotation=rotation, translation=translation)

    def cost(self, views: BoardViews) -> float:
        """What the motion of some views costs, pixels²."""
        return float((self.steps(views) ** 2 * self.weights(views)).sum())


def turned(poses: Rigid, step: np.ndarray) -> Rigid:
    """Turn and shift each of N poses by a step [N, 6]."""
    turn = Rotation.from_rotvec(step[:, :3]).as_matrix()
    return Rigid(turn @ poses.rotation, poses.translation + step[:, 3:])


@dataclass(frozen=True, eq=False)
class Elimination:
    """The views' own six numbers, expressed by everything else: step = -(constant + by_rows rows).

    Attributes:
        constant: [V, 6].
        by_rows: [V, 6, n + 8], by a view's camera parameters, board pose and warp.
        gain: half of what the cost loses when the motion alone is solved for.
        freedom: [V], how many of each view's six numbers the pixels rather than the prior settle.
    """

    constant: np.ndarray
    by_rows: np.ndarray
    gain: float
    freedom: np.ndarray


def eliminate(
    views: BoardViews, motion: Motion, squared: np.ndarray, pose: slice
) -> tuple[np.ndarray, Elimination]:
    """Take the motion out of the views' normal equations.

    Args:
        views, motion: the views and how the board moves in them.
        squared: [V, n + 9, n + 9], products of the columns of `normal_equations.linearise`, residuals last.
        pose: where the board's pose stands among them.

    Returns:
        the products without the motion, and what recovers it.
    """
    of_pose = squared[:, pose].copy()  # [V, 6, n + 9]
    weights = motion.weights(views)
    of_pose[..., -1] += motion.steps(views) * weights
    inverse = _inverse(squared[:, pose, pose] + weights[..., None] * np.eye(6))
    solved = inverse @ of_pose
    reduced = squared - np.swapaxes(squared[:, pose], -1, -2) @ solved
    gain = 0.5 * float((of_pose[..., -1] * solved[..., -1]).sum())
    freedom = np.einsum("vij,vji->v", inverse, squared[:, pose, pose])
    return reduced, Elimination(solved[..., -1], solved[..., :-1], gain, freedom)


def _inverse(matrices: np.ndarray) -> np.ndarray:
    """Invert symmetric [V, 6, 6] after scaling their unlike units away."""
    scale = 1 / np.sqrt(np.einsum("vii->vi", matrices))
    scaled = matrices * scale[..., None] * scale[..., None, :]
    return np.linalg.inv(scaled) * scale[..., None] * scale[..., None, :]
