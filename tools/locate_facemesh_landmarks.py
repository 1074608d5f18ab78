"""Locate FaceMesh's 468 surface landmarks on the studio's head template.

FaceMesh's indices have no written anatomical definition. This script renders heads of a seed that no
studio uses by default, detects the landmarks in near-frontal views, casts the detected pixels back onto
the known surface, carries the hits to the average head, and takes the median per index. The result is
`synthetic_studio/facemesh_on_template.json`: a triangle of the finest skin and barycentric weights per
index. What FaceMesh gets wrong on all heads alike is therefore part of the definition; what it gets wrong
on one head is not.

    python tools/locate_facemesh_landmarks.py --identities 24
"""

import json
from pathlib import Path

import numpy as np
from tqdm import tqdm

from preface.cli.usage import Parser
from preface.geometry import Camera, Rigid
from preface.srgb import encode
from synthetic_studio.facemesh import detect, look_at
from synthetic_studio.heads import Head, build_head
from synthetic_studio.raycasting import raycasting_scene
from synthetic_studio.regions import head_regions
from synthetic_studio.render import HeadRenderer
from synthetic_studio.template import head_template

SEED = 990_001
VIEWS = ((0.0, 0.0), (5.0, 3.0), (-5.0, 3.0), (4.0, -4.0), (-4.0, -4.0))  # azimuth and elevation, degrees
CAMERA = Camera("PINHOLE", 256, 384, np.array([900.0, 900.0, 128.0, 192.0]))
OUTPUT = Path(__file__).parent / "synthetic_studio" / "facemesh_on_template.json"


def main() -> None:
    """Detect, cast back, average and write the table."""
    parser = Parser(description=__doc__.splitlines()[0])
    parser.add_argument("--identities", type=int, default=24, help="heads to render")
    count = parser.parse_args().identities
    positions = [_positions_on_average(index) for index in tqdm(range(count), desc="heads")]
    median = np.nanmedian(np.concatenate(positions), axis=0)
    spread = np.nanmedian(np.abs(np.concatenate(positions) - median), axis=0)
    triangle, weights = _closest_on_average(median)
    rows = [
        {"triangle": int(t), "weights": [round(float(w), 6) for w in ws]}
        for t, ws in zip(triangle, weights, strict=True)
    ]
    text = json.dumps({"seed": SEED, "identities": count, "landmarks": rows}).replace(
        '{"triangle"', '\n{"triangle"'
    )
    OUTPUT.write_text(text + "\n")
    print(f"median spread about the located points {1e3 * np.linalg.norm(spread, axis=1).mean():.2f} mm")
    print(OUTPUT)


def _positions_on_average(index: int) -> np.ndarray:
    """Return where each landmark of one head lies on the average head: ``[views, 468, 3]``, NaN where unseen."""
    head = build_head(SEED, index)
    renderer = HeadRenderer(head)
    rows = []
    for azimuth, elevation in VIEWS:
        pose = look_at(azimuth, elevation)
        image = np.round(
            255.0 * encode(np.clip(renderer.render(CAMERA, pose, antialias=2).radiance, 0.0, 1.0))
        ).astype(np.uint8)
        pixels = detect(image)
        rows.append(np.full((468, 3), np.nan) if pixels is None else _cast_back(head, pose, pixels[:468]))
    return np.stack(rows)


def _cast_back(head: Head, camera_from_studio: Rigid, pixels: np.ndarray) -> np.ndarray:
    xy, _ = CAMERA.unproject(pixels)
    directions = np.c_[xy, np.ones(len(xy))] @ camera_from_studio.rotation
    origin = np.broadcast_to(camera_from_studio.inverse.translation, directions.shape)
    skin = raycasting_scene([(head.surface.vertices, head.surface.triangles)])
    hit = skin.cast_rays(np.concatenate([origin, directions], axis=1).astype(np.float32), nthreads=1)
    found = np.isfinite(hit["t_hit"].numpy())
    uv = hit["primitive_uvs"].numpy()
    weights = np.stack([1.0 - uv.sum(axis=1), uv[:, 0], uv[:, 1]], axis=1)
    corners = head.surface.triangles[np.where(found, hit["primitive_ids"].numpy().astype(np.int64), 0)]
    average = np.einsum("pk,pkc->pc", weights, head_regions().position[corners])
    return np.where(found[:, None], average, np.nan)


def _closest_on_average(position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    scene = raycasting_scene([(head_regions().position, head_template().triangles)])
    answer = scene.compute_closest_points(position.astype(np.float32))
    uv = answer["primitive_uvs"].numpy().astype(np.float64)
    return answer["primitive_ids"].numpy().astype(np.int64), np.stack(
        [1.0 - uv.sum(axis=1), uv[:, 0], uv[:, 1]], axis=1
    )


if __name__ == "__main__":
    main()
