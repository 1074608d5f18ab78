"""A small reader of a nerfstudio folder, by its documentation and its code, with nothing of preface in it.

docs.nerf.studio, "Data conventions": camera to world, x right, y up, z back; pixel (0, 0) has its centre at
(0.5, 0.5). nerfstudio/cameras/camera_utils.py: distortion is undone by ten Newton steps from the distorted
point, with radial 1 + r (k1 + r (k2 + r (k3 + r k4))) in r = x² + y², and OpenCV's tangential terms.
"""

import json

import numpy as np
from PIL import Image


def frames(folder):
    """The frames of a folder by the names of their images."""
    content = json.loads((folder / "transforms.json").read_text())
    assert content["camera_model"] == "OPENCV"
    assert len(content["applied_transform"]) == 3
    return {frame["file_path"]: frame for frame in content["frames"]}, content


def image(folder, frame):
    """Pixels as they are stored, and the mask where there is one."""
    with Image.open(folder / frame["file_path"]) as file:
        pixels = np.asarray(file)
    if "mask_path" not in frame:
        return pixels, None
    with Image.open(folder / frame["mask_path"]) as file:
        return pixels, np.asarray(file)


def distorted(frame, x, y):
    """Where the lens puts normalised points."""
    k1, k2, k3, p1, p2 = (frame.get(name, 0.0) for name in ("k1", "k2", "k3", "p1", "p2"))
    r = x * x + y * y
    radial = 1 + r * (k1 + r * (k2 + r * (k3 + r * frame.get("k4", 0.0))))
    return (
        x * radial + 2 * p1 * x * y + p2 * (r + 2 * x * x),
        y * radial + 2 * p2 * x * y + p1 * (r + 2 * y * y),
    )


def rays(frame):
    """Origins and directions [h, w, 3] of depth one of all pixels, float64."""
    x_pixel, y_pixel = np.meshgrid(np.arange(frame["w"]) + 0.5, np.arange(frame["h"]) + 0.5)
    xd, yd = (x_pixel - frame["cx"]) / frame["fl_x"], (y_pixel - frame["cy"]) / frame["fl_y"]
    x, y, step = xd.copy(), yd.copy(), 1e-6
    for _ in range(10):
        fx, fy = (a - b for a, b in zip(distorted(frame, x, y), (xd, yd), strict=True))
        columns = []
        for dx, dy in ((step, 0), (0, step)):
            ahead, behind = distorted(frame, x + dx, y + dy), distorted(frame, x - dx, y - dy)
            columns.append([(a - b) / (2 * step) for a, b in zip(ahead, behind, strict=True)])
        (xx, yx), (xy, yy) = columns
        determinant = xx * yy - xy * yx
        x, y = x - (fx * yy - fy * xy) / determinant, y - (fy * xx - fx * yx) / determinant
    matrix = np.array(frame["transform_matrix"])
    in_camera = np.stack([x, -y, -np.ones_like(x)], axis=-1)
    directions = in_camera @ matrix[:3, :3].T
    return np.broadcast_to(matrix[:3, 3], directions.shape), directions


def projected(frame, points):
    """Pixels [..., 2] of points [..., 3] of the world."""
    matrix = np.array(frame["transform_matrix"])
    in_camera = (points - matrix[:3, 3]) @ matrix[:3, :3]
    x, y = in_camera[..., 0] / -in_camera[..., 2], in_camera[..., 1] / in_camera[..., 2]
    xd, yd = distorted(frame, x, y)
    return np.stack([xd * frame["fl_x"] + frame["cx"], yd * frame["fl_y"] + frame["cy"]], axis=-1)
