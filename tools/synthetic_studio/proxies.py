"""Proxies: MakeHuman's meshes that are bound to the body, as they come for the web.

A proxy is three.js JSON (its "JSON Model format 3") with the binding of MakeHuman's mhclo files:
every vertex is a weighted mean of three vertices of the hm08 body plus an offset in decimetres.
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from preface.artifacts import ArtifactError, load_json

HM08_VERTEX_COUNT = 19158  # with all helpers
# mhclo files scale offsets along each axis by the distance of two body vertices. These pairs, and their
# distances on the base body in decimetres, are those of MakeHuman's own hair.
OFFSET_SCALES = ((5399, 11998, 1.4800), (791, 881, 2.3298), (962, 5320, 1.9221))
UNPACK_AGAIN = "Unpack the assets again, or remove this asset's folder"
# Bits of a face's type: what its numbers are besides the corners.
QUAD, MATERIAL, FACE_UV, CORNER_UVS, FACE_NORMAL, CORNER_NORMALS, FACE_COLOUR, CORNER_COLOURS = (
    1 << bit for bit in range(8)
)


@dataclass(frozen=True)
class Proxy:
    """A mesh that follows the body.

    Attributes:
        path: Its JSON file.
        words: Lower-case words of its name and tags, such as "short" and "male".
        references: ``[V, 3]`` hm08 vertices.
        weights: ``[V, 3]`` their weights.
        offsets: ``[V, 3]`` decimetres in the studio's axes, which are MakeHuman's too.
        faces: ``[F, 4]`` if all are quads, or else ``[F, 3]``.
        corner_uvs: ``[F, 4, 2]`` or ``[F, 3, 2]`` texture coordinates as column and row, mostly 0..1.
        textures: Images by the name of the material; the first one is the default.
    """

    path: Path
    words: tuple[str, ...]
    references: np.ndarray
    weights: np.ndarray
    offsets: np.ndarray
    faces: np.ndarray
    corner_uvs: np.ndarray
    textures: dict[str, Path]

    @property
    def name(self) -> str:
        """The file's name without its suffix."""
        return self.path.stem

    def fit(self, body: np.ndarray) -> np.ndarray:
        """Return the vertices ``[V, 3]`` in metres on an upright body ``[19158, 3]`` in metres."""
        scale = [
            abs(body[a, axis] - body[b, axis]) / decimetres
            for axis, (a, b, decimetres) in enumerate(OFFSET_SCALES)
        ]
        return np.einsum("vk,vkc->vc", self.weights, body[self.references]) + self.offsets * scale


def read_proxy(path: Path) -> Proxy:
    """Read and check a proxy.

    Raises:
        ArtifactError: unreadable, fields that are missing or do not fit together, or a texture that is not there.
    """
    payload = load_json(path)
    references = _table(path, payload, "ref_vIdxs", HM08_VERTEX_COUNT)
    weights, offsets = _table(path, payload, "weights"), _table(path, payload, "offsets")
    for field, values in (("weights", weights), ("offsets", offsets)):
        if len(values) != len(references):
            problem = f"has {len(values)} rows, but ref_vIdxs has {len(references)}"
            raise ArtifactError(path, field, problem, UNPACK_AGAIN)
    layers = payload.get("uvs")
    if not (isinstance(layers, list) and layers):
        raise ArtifactError(path, "uvs", "has no layer of texture coordinates", UNPACK_AGAIN)
    try:
        uvs = np.array(layers[0], np.float64).reshape(-1, 2)
        faces, uv_faces = _faces(payload["faces"], len(layers))
        # Indexing refuses what is out of range.
        references[faces]
        corner_uvs = np.stack([uvs[uv_faces][..., 0], 1.0 - uvs[uv_faces][..., 1]], axis=-1)
    except (KeyError, IndexError, TypeError, ValueError) as error:
        problem = f"do not describe triangles or quads with texture coordinates ({error})"
        raise ArtifactError(path, "faces", problem, UNPACK_AGAIN) from error
    metadata = payload.get("metadata")
    tags = metadata.get("tags") if isinstance(metadata, dict) else None
    label = " ".join([path.stem, *map(str, tags if isinstance(tags, list) else [])])
    return Proxy(
        path=path,
        words=name_words(label),
        references=references,
        weights=weights,
        offsets=offsets,
        faces=faces,
        corner_uvs=corner_uvs.astype(np.float32),
        textures=_textures(path, payload),
    )


def name_words(name: str) -> tuple[str, ...]:
    """Return the lower-case words of a name like "young_asian_male2"."""
    return tuple(re.findall("[a-z]+", name.lower()))


def texture_path(path: Path, field: str, value: Any) -> Path:
    """Return where a material's texture lies; raises ArtifactError when there is no such file."""
    if not isinstance(value, str):
        raise ArtifactError(path, field, "is not the name of an image", UNPACK_AGAIN)
    texture = path.parent / value
    if not texture.is_file():
        raise ArtifactError(path, field, f"names {value}, which is not there", UNPACK_AGAIN)
    return texture


def _table(path: Path, payload: dict[str, Any], field: str, limit: int | None = None) -> np.ndarray:
    """Return a field's rows of three numbers; of whole numbers below ``limit`` if there is one."""
    try:
        values = np.array(payload[field], np.float64)
    except (KeyError, TypeError, ValueError) as error:
        raise ArtifactError(path, field, "is missing or not a table of numbers", UNPACK_AGAIN) from error
    if values.ndim != 2 or values.shape[1] != 3 or not len(values):
        raise ArtifactError(path, field, f"has the shape {values.shape}, not [vertices, 3]", UNPACK_AGAIN)
    if limit is None:
        return values
    if (values != np.floor(values)).any() or values.min() < 0 or values.max() >= limit:
        problem = f"does not hold vertex numbers of the hm08 body, 0 to {limit - 1}"
        raise ArtifactError(path, field, problem, "Give an asset that was made for the base mesh hm08")
    return values.astype(np.int64)


def _faces(numbers: list[int], uv_layers: int) -> tuple[np.ndarray, np.ndarray]:
    """Decode three.js faces into vertices and texture coordinates, two ``[F, 4]`` if all are quads, or ``[F, 3]``."""
    faces: list[list[int]] = []
    uv_faces: list[list[int]] = []
    at = 0
    while at < len(numbers):
        kind = numbers[at]
        if not kind & CORNER_UVS:
            raise ValueError(f"the face at {at} has none")
        size = 4 if kind & QUAD else 3
        vertices = at + 1
        uvs = vertices + size + bool(kind & MATERIAL) + uv_layers * bool(kind & FACE_UV)
        at = uvs + size * uv_layers + bool(kind & FACE_NORMAL) + size * bool(kind & CORNER_NORMALS)
        at += bool(kind & FACE_COLOUR) + size * bool(kind & CORNER_COLOURS)
        if at > len(numbers):
            raise ValueError("the last face is cut short")
        faces.append(numbers[vertices : vertices + size])
        uv_faces.append(numbers[uvs : uvs + size])
    if any(len(set(face)) < 4 for face in faces):  # a triangle, or a quad with a repeated corner
        faces, uv_faces = _fans(faces, uv_faces)
    found = np.array(faces, np.int64), np.array(uv_faces, np.int64)
    if not faces or min(found[0].min(), found[1].min()) < 0:
        raise ValueError("there are none, or an index is negative")
    return found


def _fans(faces: list[list[int]], uv_faces: list[list[int]]) -> tuple[list[list[int]], list[list[int]]]:
    """Split faces and their texture coordinates into triangles, without those that have no area."""
    fans = [
        ([face[0], face[k], face[k + 1]], [uvs[0], uvs[k], uvs[k + 1]])
        for face, uvs in zip(faces, uv_faces, strict=True)
        for k in range(1, len(face) - 1)
    ]
    solid = [(triangle, uvs) for triangle, uvs in fans if len(set(triangle)) == 3]
    return [triangle for triangle, _ in solid], [uvs for _, uvs in solid]


def _textures(path: Path, payload: dict[str, Any]) -> dict[str, Path]:
    """Return the textures of all materials that have one."""
    materials = payload.get("materials")
    found = {
        str(material.get("DbgName", index)): texture_path(
            path, f"materials[{index}].mapDiffuse", material["mapDiffuse"]
        )
        for index, material in enumerate(materials if isinstance(materials, list) else [])
        if isinstance(material, dict) and "mapDiffuse" in material
    }
    if not found:
        raise ArtifactError(path, "materials", "none has a texture (mapDiffuse)", UNPACK_AGAIN)
    return found
