"""From photographs to tracks, poses and points: pycolmap's features, matches and incremental mapping."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from preface.capture.photos.adjustment import read_poses
from preface.capture.photos.files import Photograph
from preface.capture.photos.structure import Structure, Tracks
from preface.geometry.cameras import Camera

# The lens that mapping itself assumes: one coefficient absorbs what would otherwise bend the scene, and
# cannot run away as higher ones do. The model that is reported is chosen afterwards.
MAPPING_MODEL = "SIMPLE_RADIAL"
MIN_MATCHES = 15  # verified matches of a pair, pycolmap's own threshold
MAX_MODELS = 3  # separate reconstructions to try before giving up on the remaining photographs


@dataclass(frozen=True)
class MappingOptions:
    """Settings of pycolmap.

    Attributes:
        max_image_size: longer side at which features are sought, pixels.
        max_features: per photograph.
        seed: of all sampling, not negative.
        threads: for everything.
    """

    max_image_size: int
    max_features: int
    seed: int
    threads: int


@dataclass(frozen=True)
class Mapped:
    """What mapping found.

    Attributes:
        images: indices of the registered photographs, ascending; the structure's order.
        cameras: indices of the cameras that took them, ascending; the structure's order.
        structure: in an arbitrary frame and scale.
        tracks: its sightings.
        missing: why each other photograph, by index, was not registered.
    """

    images: tuple[int, ...]
    cameras: tuple[int, ...]
    structure: Structure
    tracks: Tracks
    missing: Mapping[int, str]


class MappingError(Exception):
    """Nothing could be reconstructed; the message is the reason."""


def map_photographs(
    photographs: Sequence[Photograph],
    names: Sequence[str],
    folder: Path,
    masked: bool,
    options: MappingOptions,
) -> Mapped:
    """Reconstruct photographs.

    Args:
        photographs: as given by the user.
        names: of their copies in ``folder/images``.
        folder: as `preface.capture.photos.files.stage` left it; the database is put there too.
        masked: whether ``folder/masks`` is to be heeded.
        options: settings.

    Raises:
        MappingError: no two photographs fit together.
    """
    database_path = folder / "database.db"
    with _quiet_log():
        pycolmap.set_random_seed(options.seed)
        _find_features(photographs, names, folder, masked, database_path, options)
        _match(database_path, options)
        (folder / "models").mkdir()
        found = pycolmap.incremental_mapping(
            database_path, folder / "images", folder / "models", _pipeline_options(options)
        )
        with pycolmap.Database.open(database_path) as database:
            evidence = _Evidence.read(database, names)
    if not found:
        raise MappingError(evidence.summary())
    models = sorted(found.values(), key=lambda model: (-model.num_reg_images(), -model.num_points3D()))
    groups = [{names.index(model.images[i].name) for i in model.reg_image_ids()} for model in models]
    images = sorted(groups[0])
    missing = {
        index: evidence.reason(index, groups) for index in range(len(photographs)) if index not in groups[0]
    }
    cameras = sorted({photographs[index].camera for index in images})
    structure, tracks = _read(models[0], photographs, names, images, cameras)
    return Mapped(tuple(images), tuple(cameras), structure, tracks, missing)


def _find_features(
    photographs: Sequence[Photograph],
    names: Sequence[str],
    folder: Path,
    masked: bool,
    database_path: Path,
    options: MappingOptions,
) -> None:
    """Extract features, camera by camera, each starting from its photographs' EXIF focal length."""
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.max_image_size = options.max_image_size
    extraction.num_threads = options.threads
    extraction.use_gpu = False
    extraction.sift.max_num_features = options.max_features
    for camera in sorted({photograph.camera for photograph in photographs}):
        mine = [index for index, photograph in enumerate(photographs) if photograph.camera == camera]
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = MAPPING_MODEL
        if masked:
            reader.mask_path = folder / "masks"
        focals = [focal for i in mine if (focal := photographs[i].exif_focal) is not None]
        if focals:
            first = photographs[mine[0]]
            reader.camera_params = f"{np.median(focals)},{first.width / 2},{first.height / 2},0"
        pycolmap.extract_features(
            database_path,
            folder / "images",
            [names[index] for index in mine],
            pycolmap.CameraMode.SINGLE,
            reader,
            extraction,
            device=pycolmap.Device.cpu,
        )


def _match(database_path: Path, options: MappingOptions) -> None:
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = options.threads
    matching.use_gpu = False
    verification = pycolmap.TwoViewGeometryOptions()
    verification.min_num_inliers = MIN_MATCHES
    verification.ransac.random_seed = options.seed
    pycolmap.match_exhaustive(
        database_path, matching, verification_options=verification, device=pycolmap.Device.cpu
    )


def _pipeline_options(options: MappingOptions) -> pycolmap.IncrementalPipelineOptions:
    pipeline = pycolmap.IncrementalPipelineOptions()
    pipeline.min_num_matches = MIN_MATCHES
    pipeline.min_model_size = 2  # small sets are welcome; too small ones are judged later, with a message
    pipeline.max_num_models = MAX_MODELS
    pipeline.extract_colors = False
    pipeline.num_threads = options.threads
    pipeline.random_seed = options.seed
    pipeline.mapper.num_threads = options.threads
    pipeline.mapper.random_seed = options.seed
    pipeline.triangulation.random_seed = options.seed
    return pipeline


def _read(
    model: pycolmap.Reconstruction,
    photographs: Sequence[Photograph],
    names: Sequence[str],
    images: list[int],
    cameras: list[int],
) -> tuple[Structure, Tracks]:
    """Turn pycolmap's reconstruction into arrays, photographs, cameras and points in ascending order."""
    by_name = {image.name: image for image in model.images.values()}
    registered = [by_name[names[index]] for index in images]
    lenses: dict[int, Camera] = {}
    for index, image in zip(images, registered, strict=True):
        lens = model.cameras[image.camera_id]
        size = (int(lens.width), int(lens.height))
        lenses[photographs[index].camera] = Camera(lens.model_name, *size, np.array(lens.params))
    point_ids = sorted(model.points3D)
    point_index = {point_id: index for index, point_id in enumerate(point_ids)}
    sightings = [
        (slot, point_index[sighting.point3D_id], *sighting.xy)
        for slot, image in enumerate(registered)
        for sighting in image.get_observation_points2D()
    ]
    table = np.array(sightings, np.float64).reshape(-1, 4)
    structure = Structure(
        tuple(lenses[camera] for camera in cameras),
        read_poses(registered),
        np.array([model.points3D[point_id].xyz for point_id in point_ids]),
    )
    camera_of_image = np.array([cameras.index(photographs[index].camera) for index in images])
    tracks = Tracks(camera_of_image, table[:, 0].astype(int), table[:, 1].astype(int), table[:, 2:])
    return structure, tracks


@dataclass(frozen=True)
class _Evidence:
    """What the database says of photographs: features [N], verified matches of pairs [N, N]."""

    features: np.ndarray
    matches: np.ndarray

    @classmethod
    def read(cls, database: pycolmap.Database, names: Sequence[str]) -> "_Evidence":
        index = {image.image_id: names.index(image.name) for image in database.read_all_images()}
        features, matches = np.zeros(len(names), int), np.zeros((len(names), len(names)), int)
        for image_id, i in index.items():
            features[i] = database.num_keypoints_for_image(image_id)
        pair_ids, counts = database.read_two_view_geometry_num_inliers()
        for pair_id, count in zip(pair_ids, counts, strict=True):
            i, j = (index[image_id] for image_id in pycolmap.pair_id_to_image_pair(pair_id))
            matches[i, j] = matches[j, i] = count
        return cls(features, matches)

    def reason(self, image: int, groups: Sequence[set[int]]) -> str:
        """Why a photograph is not part of the first group."""
        matches = int(self.matches[image, sorted(groups[0])].max())
        for group in groups[1:]:
            if image in group:
                return (
                    f"fits together with {len(group) - 1} other photographs, but not with the rest; take some "
                    "from viewpoints between the two groups"
                )
        if self.features[image] < MIN_MATCHES:
            return f"shows {self.features[image]} features; it may be blurred, blank or masked"
        if matches < MIN_MATCHES:
            return (
                f"shares {matches} verified matches with any registered photograph, {MIN_MATCHES} are needed; "
                "take neighbours about 10 degrees apart, with texture in view"
            )
        return f"shares up to {matches} matches with registered photographs, but no pose fits them well"

    def summary(self) -> str:
        """Why nothing could be reconstructed."""
        best = int(self.matches.max())
        if best < MIN_MATCHES:
            return (
                f"no two photographs match (up to {best} verified matches, {MIN_MATCHES} are needed; "
                f"{np.median(self.features):.0f} features in the median photograph)"
            )
        return f"no pair of photographs (up to {best} matches) shows its points from two sides"


@contextmanager
def _quiet_log() -> Iterator[None]:
    """Keep pycolmap's progress off the terminal; errors still show."""
    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = level
