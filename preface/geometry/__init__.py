"""Cameras, poses, similarities, rays and boxes, and the conventions that the whole project obeys.

Conventions
-----------
- Lengths are in metres; angles in radians in code, in degrees only in reports.
- World, rig and canonical frames are right-handed. Camera axes are those of OpenCV and COLMAP: x right,
  y down, z forward.
- A transform is named `target_from_source` (`camera_from_rig`, `canonical_from_rig`); matrices act on
  column vectors; quaternions are wxyz with w >= 0.
- The canonical frame: origin at the mean of the template's five keypoints, x to the subject's left, y up,
  z out of the face. Metric.
- Pixel coordinates are continuous, (x, y), with the centre of the top-left pixel at (0.5, 0.5), as in COLMAP.
  OpenCV's (0, 0) is converted at its boundary (`conventions`) and nowhere else. Resizing an image then
  scales K exactly.
- The model sees canonical metres times `scene_scale`, which makes the longest half side of the canonical
  box 1; it is stored with the shards and the checkpoint.
- Keypoints in order: right_eye_outer, left_eye_outer, nose_tip, mouth_center, chin ("right" is the
  subject's right).
- Colours are sRGB-encoded: uint8 in shards and on disk, floats in [0, 1] in the model; linear only inside
  a filter or a renderer that says so.
- Calibration, triangulation and alignment run in float64. Rays are formed in float64 and stored or used
  in float32 about the canonical origin.
- Randomness is a pure function of (seed, step).
- What cannot be computed is NaN and masked (`valid`, `hit`), or a `GeometryError`; never a silent value.

Reading order
-------------
`lens` (the camera model as formulas), `cameras` (the model as a checked object), `transforms`, `similarity`,
`rays`, `boxes`, `conventions`. `lens`, `rays` and the intersection of boxes take numpy arrays or torch
tensors and run the same lines for both.

    camera = Camera("OPENCV", 4096, 6144, [13500, 13500, 2048, 3072, -0.1, 0.05, 1e-4, -2e-4])
    pixels, valid = camera.project(camera_from_rig.apply(points))          # [n, 2], [n]
    views = Views.stack([camera], [camera_from_rig.inverse])
    rays = cast_rays(views[0], pixel_centers(camera.width, camera.height))  # [6144, 4096, ...]
    near, far, hit = box.intersect(rays.origins, rays.directions)
"""

from preface.geometry.boxes import Box, intersect_box
from preface.geometry.cameras import CAMERA_MODELS, Camera, stack_intrinsics
from preface.geometry.errors import GeometryError
from preface.geometry.rays import Rays, Views, cast_rays, pixel_centers
from preface.geometry.similarity import SimilarityFit, fit_similarity, fit_similarity_robust
from preface.geometry.transforms import (
    Rigid,
    Similarity,
    nearest_rotation,
    quaternion_from_rotation,
    rotation_from_quaternion,
    validate_rotation,
)

__all__ = [
    "CAMERA_MODELS",
    "Box",
    "Camera",
    "GeometryError",
    "Rays",
    "Rigid",
    "Similarity",
    "SimilarityFit",
    "Views",
    "cast_rays",
    "fit_similarity",
    "fit_similarity_robust",
    "intersect_box",
    "nearest_rotation",
    "pixel_centers",
    "quaternion_from_rotation",
    "rotation_from_quaternion",
    "stack_intrinsics",
    "validate_rotation",
]
