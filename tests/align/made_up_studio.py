"""An aligned studio whose every number is known: faces of iBUG's 68 points before a rig of three cameras."""

from dataclasses import replace

import numpy as np

from preface.align.aligned import AlignedStudio
from preface.align.keypoints import CANONICAL_KEYPOINTS, IBUG68
from preface.align.keypoints3d import Keypoints
from preface.align.landmarks import NoFace, ViewLandmarks, box_around
from preface.align.placement import Placement
from preface.align.subject import SubjectAlignment
from preface.align.template import Template
from preface.align.triangulation import Triangulation
from preface.align.view_check import ViewVerdict
from preface.capture.rig import Rig, RigCamera
from preface.geometry import Camera, Rigid, Similarity

SIZE = (240, 320)
CAMERAS = ("left", "middle", "right")
ANGLES = (20.0, 0.0, -20.0)  # degrees about the subject's axis
TEMPLATE = np.array(
    [(-0.045, 0.03, 0.0), (0.045, 0.03, 0.0), (0.0, -0.01, 0.04), (0.0, -0.045, 0.02), (0.0, -0.085, 0.0)]
)
TEMPLATE = TEMPLATE - TEMPLATE.mean(axis=0)


def rig(names=CAMERAS, angles=ANGLES, take="take"):
    """Cameras at 1 m around a subject who looks along z."""
    lens = Camera("PINHOLE", *SIZE, np.array([900.0, 900.0, SIZE[0] / 2, SIZE[1] / 2]))
    cameras = {}
    for name, angle in zip(names, np.radians(angles), strict=True):
        around = np.array([(np.cos(angle), 0, -np.sin(angle)), (0, 1, 0), (np.sin(angle), 0, np.cos(angle))])
        cameras[name] = RigCamera.at(lens, Rigid(np.diag([1.0, -1.0, -1.0]) @ around, np.array([0, 0, 1.0])))
    return Rig(take, cameras)


def face(keypoints, seed=0):
    """68 points [68, 3] among which the canonical keypoints are the given ones [5, 3]."""
    points = np.random.default_rng(seed).uniform(-0.05, 0.05, (IBUG68.size, 3))
    for name, place in zip(CANONICAL_KEYPOINTS, keypoints, strict=True):
        points[list(IBUG68.keypoints[name])] = place
    return points


def seen(points, camera):
    """The landmarks that a camera sees, without noise."""
    pixels, _ = camera.camera.project(camera.camera_from_rig.apply(points))
    count = len(points)
    return ViewLandmarks("ibug68", pixels, np.full(count, 0.5), np.ones(count), box_around(pixels))


def verdict(code="agrees", reason="", disagreement=0.01):
    return ViewVerdict(code in ("agrees", "unchecked"), code, reason, np.full(5, disagreement))


def subject(keypoints, verdicts, excluded=None):
    """A person whose views have these verdicts; residuals are half a pixel."""
    used = tuple(name for name, of_view in verdicts.items() if of_view.used)
    points, count = face(keypoints), IBUG68.size
    triangulation = Triangulation(
        points=points,
        covariance=np.broadcast_to(1e-8 * np.eye(3), (count, 3, 3)),
        inliers=np.ones((count, len(used)), bool),
        residuals=np.full((count, len(used)), 0.5),
        angle=np.full(count, 0.7),
        reason=np.zeros(count, np.int8),
    )
    known = Keypoints(
        keypoints, np.broadcast_to(1e-8 * np.eye(3), (5, 3, 3)).copy(), np.full(5, len(used)), ("",) * 5
    )
    return SubjectAlignment("ibug68", used, triangulation, known, verdicts, 1.0, excluded)


def placed(shift=(0.0, 0.0, 0.0), residual=0.0):
    """A person who was moved into the canonical frame."""
    move = Similarity(1.0, np.eye(3), np.array(shift))
    return Placement(move, np.full(5, residual), np.full(5, 0.2), ())


def made_up(offsets=((0.0, 0.0, 0.0), (0.003, 0.0, 0.0), (-0.003, 0.0, 0.0))):
    """People who differ only in where they stand [S, 3], metres, and who are aligned perfectly."""
    one_rig = rig()
    people = {f"p{index}": TEMPLATE + offset for index, offset in enumerate(np.array(offsets))}
    return AlignedStudio(
        landmarks={(p, c): seen(face(k), one_rig.cameras[c]) for p, k in people.items() for c in CAMERAS},
        rigs=dict.fromkeys(people, one_rig),
        subjects={p: subject(k, {c: verdict() for c in CAMERAS}) for p, k in people.items()},
        template=Template("ibug68", TEMPLATE, Rigid.identity(), tuple(people), False, np.zeros(5)),
        joined=False,
        placements={p: placed(-(k - TEMPLATE)[0]) for p, k in people.items()},
        excluded={},
    )


def with_verdict(studio, person, camera, of_view):
    """The studio with another verdict about one view."""
    old = studio.subjects[person]
    new = subject(old.keypoints.positions, {**old.views, camera: of_view}, old.excluded)
    return replace(studio, subjects={**studio.subjects, person: new})


def without_face(studio, person, camera, reason="no face found at any scale or rotation"):
    """The studio with a view in which nobody is found."""
    changed = with_verdict(studio, person, camera, verdict("no_face", reason, np.nan))
    return replace(changed, landmarks={**studio.landmarks, (person, camera): NoFace(reason)})


def excluding(studio, person, reason):
    """The studio with one person left out."""
    placements = {name: place for name, place in studio.placements.items() if name != person}
    return replace(studio, placements=placements, excluded={**studio.excluded, person: reason})
