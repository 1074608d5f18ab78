"""Which views a head is evaluated at, where their cameras stand, and which square of them is the face."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from preface.artifacts import ArtifactError
from preface.geometry import Camera, Rigid
from preface.model.training.prior_files import Prior
from preface.plain_words import suggestion
from preface.shards import Dataset
from preface.shards.heads import standing

BOX_TOLERANCE = 1e-6  # metres; boxes are written in full, so that anything more is another box


@dataclass(frozen=True)
class Square:
    """A square of an image: its first column and row and its side, whole pixels."""

    left: int
    top: int
    side: int

    def of(self, image: np.ndarray) -> np.ndarray:
        """The part [side, side, ...] of an image [H, W, ...]."""
        return image[self.top : self.top + self.side, self.left : self.left + self.side]


@dataclass(frozen=True, eq=False)
class StandingCamera:
    """The camera of a view: the lens, and canonical_from_camera in metres."""

    name: str
    camera: Camera
    canonical_from_camera: Rigid


def identity_of(prior: Prior, asked: str | None) -> str:
    """The identity that a head is of, or that a prior is asked for.

    Raises:
        ArtifactError: the model does not know it, or knows several and none was asked for.
    """
    names = prior.identities
    if asked is None and len(names) == 1:
        return names[0]
    if asked is None:
        shown = ", ".join(names[:5]) + (" ..." if len(names) > 5 else "")
        problem = f"are {len(names)} ({shown}), and none was chosen"
        raise ArtifactError(prior.path, "identities", problem, "Choose one by --identity")
    if asked not in names:
        raise ArtifactError(prior.path, "identities", f"there is no '{asked}'", suggestion(asked, names))
    return asked


def number_of(dataset: Dataset, identity: str) -> int:
    """The number of an identity in a dataset.

    Raises:
        ArtifactError: it is not there.
    """
    if identity not in dataset.names:
        remedy = suggestion(identity, dataset.names)
        raise ArtifactError(dataset.manifest.path, "identities", f"there is no '{identity}'", remedy)
    return dataset.names.index(identity)


def camera_names(dataset: Dataset, identity: str) -> dict[str, int]:
    """The number of each view that there is of an identity, by the name of its camera."""
    number = number_of(dataset, identity)
    cameras = dataset.manifest.identities[number].cameras
    valid = dataset.tables["view_valid"][number] == 1
    return {str(name): view for view, name in enumerate(cameras) if valid[view]}


def fitted_views(prior: Prior, dataset: Dataset, identity: str) -> tuple[str, ...]:
    """The views of an identity that a model has seen: those a head was fitted to, or that a prior trained on.

    A prior's are all that it did not hold out, of the identities that it knows.
    """
    if prior.fit is not None:
        return tuple(prior.fit["views"])
    held_out = set(prior.held_out.get(identity, ()))
    return tuple(name for name in camera_names(dataset, identity) if name not in held_out)


def choose_views(
    priors: Sequence[Prior], dataset: Dataset, identity: str, asked: Sequence[str] | None
) -> tuple[str, ...]:
    """The views of an identity to evaluate all of these models at, in the order of the shards.

    Args:
        priors: models of the identity, to be compared on equal terms.
        dataset: with its photographs.
        identity: name.
        asked: cameras; by default all that none of the models has seen.

    Raises:
        ArtifactError: an unknown identity or camera, or nothing is left to evaluate.
    """
    there = camera_names(dataset, identity)
    if asked is not None:
        for name in asked:
            if name not in there:
                problem = f"'{identity}' has no view '{name}'"
                raise ArtifactError(dataset.manifest.path, "cameras", problem, suggestion(name, there))
        return tuple(name for name in there if name in set(asked))
    seen = {name for prior in priors for name in fitted_views(prior, dataset, identity)}
    left = tuple(name for name in there if name not in seen)
    if not left:
        problem = f"no view of '{identity}' is left that was not fitted to ({len(there)} are in the shards)"
        remedy = "Name the views to render anyway by --views, or fit to fewer"
        raise ArtifactError(priors[0].path, "views", problem, remedy)
    return left


def require_same_space(prior: Prior, dataset: Dataset) -> None:
    """Refuse shards whose canonical box is not the one that a model lives in.

    Raises:
        ArtifactError: another box or another scale.
    """
    manifest, scene = dataset.manifest, prior.scene
    same = np.abs(manifest.box - scene.box).max() <= BOX_TOLERANCE
    if not same or abs(manifest.scene_scale / scene.scene_scale - 1) > BOX_TOLERANCE:
        problem = f"is {scene.box.tolist()} m, and that of {manifest.path} is {manifest.box.tolist()} m"
        remedy = "Give the shards that it was fitted to, or build some with the same --box"
        raise ArtifactError(prior.path, "box", problem, remedy)


def standing_camera(dataset: Dataset, identity: str, name: str) -> StandingCamera:
    """The camera of a view that there is."""
    number, view = number_of(dataset, identity), camera_names(dataset, identity)[name]
    return StandingCamera(name, *standing(dataset, number, view))


def face_square(standing: StandingCamera, half_side: float) -> Square | None:
    """The square about the face: centred on the canonical origin's image, as large as `half_side` metres there.

    Its side is 2 * half_side * focal length / depth, to whole pixels, but at most the image's shorter side; where it
    would reach over an edge it is moved inside. The lens' distortion moves its centre and not its size.

    Args:
        standing: the camera.
        half_side: metres.

    Returns:
        None where the origin is behind the camera or outside the image: there is no face to crop to.
    """
    camera = standing.camera
    origin = standing.canonical_from_camera.inverse.apply(np.zeros(3))
    pixel, valid = camera.project(origin)
    size = np.array([camera.width, camera.height])
    if not valid or not ((pixel >= 0) & (pixel <= size)).all():
        return None
    focal = float(camera.intrinsics[:2].mean())
    side = min(int(size.min()), round(2 * half_side * focal / float(origin[2])))
    if side < 1:
        return None
    left, top = np.clip(np.rint(pixel - side / 2), 0, size - side).astype(int).tolist()
    return Square(left, top, side)


def degrees_between(one: Rigid, other: Rigid) -> float:
    """The angle at the canonical origin between two cameras, degrees."""
    a, b = one.translation, other.translation
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))
