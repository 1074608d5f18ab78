"""Small directories in the layouts of public datasets, written from cameras that are known.

The files are written by hand from matrices, with nothing of the package: what stands in them is the truth.
"""

import json
from dataclasses import dataclass, field

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

WIDTH, HEIGHT = 48, 64


@dataclass
class Truth:
    """A camera by OpenCV's numbers: K, world to camera, distortion k1 k2 p1 p2 k3; pixel (0, 0) as its centre."""

    K: np.ndarray
    R: np.ndarray
    t: np.ndarray
    distortion: np.ndarray = field(default_factory=lambda: np.zeros(5))

    @property
    def world2cam(self):
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.R, self.t
        return matrix

    def moved(self, scale, R, t):
        """The camera in a world y from which this one's follows by x = scale R y + t, its pixels unchanged."""
        return Truth(self.K, self.R @ R, (self.R @ t + self.t) / scale, self.distortion)


def cameras(count, distorted=False):
    """Cameras a metre from the origin, which they look at."""
    found = []
    for angle in np.linspace(-40, 40, count):
        R = np.diag([1.0, -1.0, -1.0]) @ Rotation.from_euler("yx", [angle, 3], degrees=True).as_matrix()
        K = np.array([[150.0 + angle, 0, 23.1], [0, 151.0, 31.7], [0, 0, 1]])
        distortion = np.array([-0.1, 0.05, 1e-3, -2e-3, 0.01]) if distorted else np.zeros(5)
        found.append(Truth(K, R, np.array([0.01, -0.02, 1.0]), distortion))
    return found


def write_image(path, value, size=(WIDTH, HEIGHT), mode="RGB"):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new(mode, size, value if mode == "L" else (value, 100, 50)).save(path)


def write_cafca(source, places, truths, masks=True):
    """SUBJECT/EXP_ENV/...: `places` are those, all with the same cameras C00, C01, ..."""
    for number, place in enumerate(places):
        folder = source / place
        for index, truth in enumerate(truths):
            name = f"C{index:02d}"
            write_image(folder / "color_image" / f"{name}.png", 10 * number + index)
            if masks:
                write_image(folder / "foreground_mask" / f"{name}.png", 200 + index, mode="L")
            write_image(folder / "segmentation" / f"{name}.png", 3, mode="L")
            (folder / "cameras_json").mkdir(exist_ok=True)
            content = {
                "K": truth.K.tolist(),
                "world2cam": truth.world2cam.tolist(),
                "cam2world": np.linalg.inv(truth.world2cam).tolist(),
                "P": (truth.K @ truth.world2cam[:3]).tolist(),
                "position": (-truth.R.T @ truth.t).tolist(),
                "orientation": truth.R.tolist(),
                "focal_length": truth.K[0, 0],
            }
            (folder / "cameras_json" / f"{name}.json").write_text(json.dumps(content))
        (folder / "color_image" / "environment.json").write_text('{"name": "indoor.exr"}')


def facescape_params(truths, invalid=(), serials=True):
    """The content of a params.json."""
    content = {}
    for view, truth in enumerate(truths):
        values = {
            "K": truth.K.tolist(),
            "Rt": truth.world2cam[:3].tolist(),
            "distortion": truth.distortion.tolist(),
            "width": WIDTH,
            "height": HEIGHT,
            "matches": 100,
            "valid": view not in invalid,
            "sn": f"SN{view:03d}" if serials else "",
            "ori": f"IMG_{view}.JPG",
        }
        content |= {f"{view}_{key}": value for key, value in values.items()}
    return content


def write_facescape(source, place, truths, **options):
    """PERSON/EXPRESSION with an image per view."""
    for view in range(len(truths)):
        write_image(source / place / f"{view}.jpg", view)
    write_params(source, place, facescape_params(truths, **options))


def write_params(source, place, content):
    (source / place / "params.json").write_text(json.dumps(content))
