"""Tiny made-up assets in the layout of the real ones, written where a test asks for them."""

import json

import numpy as np

from preface.capture.images import write_png

# Quads with material and texture coordinates, as MakeHuman's exporter writes them.
QUAD_WITH_UVS = 11


def write_skin(root, name, colour=(200, 150, 120), **fields):
    """A skin of one colour (sRGB)."""
    folder = root / "skins" / name
    (folder / "textures").mkdir(parents=True)
    write_png(folder / "textures" / "skin.png", np.full((32, 32, 3), colour, np.uint8))
    path = folder / f"{name}.json"
    path.write_text(json.dumps({"mapDiffuse": "textures/skin.png", **fields}))
    return path


def proxy_fields(references, offsets, faces, uvs, textures, tags=()):
    """The fields of a proxy whose vertices are body vertices plus offsets in decimetres."""
    return {
        "metadata": {"tags": list(tags)},
        "ref_vIdxs": [[int(vertex)] * 3 for vertex in references],
        "weights": [[1.0, 0.0, 0.0]] * len(references),
        "offsets": np.asarray(offsets, float).tolist(),
        "uvs": [np.asarray(uvs, float).ravel().tolist()],
        "faces": [number for face in faces for number in (QUAD_WITH_UVS, *face, 0, *face)],
        "materials": [{"DbgName": name, "mapDiffuse": f"textures/{name}.png"} for name in textures],
    }


def write_proxy(root, kind, name, fields, textures):
    """A proxy with the given fields and its textures (name to uint8 array)."""
    folder = root / "proxies" / kind / name
    (folder / "textures").mkdir(parents=True)
    for texture, pixels in textures.items():
        write_png(folder / "textures" / f"{texture}.png", pixels)
    path = folder / f"{name}.json"
    path.write_text(json.dumps(fields))
    return path


def write_sheet(root, kind, name, tags=(), reference=5399, at=(0.0, 0.0, 0.0), half=(0.5, 0.5)):
    """An opaque brown square in the image plane, about a body vertex; ``at`` and ``half`` in decimetres."""
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    offsets = np.c_[corners * half, np.zeros(4)] + at
    fields = proxy_fields([reference] * 4, offsets, [(0, 1, 2, 3)], (corners + 1) / 2, [name], tags)
    return write_proxy(root, kind, name, fields, {name: np.full((8, 8, 4), (90, 60, 40, 255), np.uint8)})
