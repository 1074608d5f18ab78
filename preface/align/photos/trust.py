"""How far each choice is trusted, in numbers and in sentences."""

import numpy as np

from preface.align.keypoints import CANONICAL_KEYPOINTS
from preface.align.photos.projection import LENS, POSE
from preface.align.photos.solve import Solution
from preface.align.photos.views import HARDLY, PhotoOptions, PhotoView, Source, Trust, rests_on

# The photographs determine a value when they reduce its expected variance by this share.
DETERMINED = 0.75
SCALE = "distance between the outer eye corners"
NAMES = {
    "right_eye_outer": "outer corner of the right eye",
    "left_eye_outer": "outer corner of the left eye",
    "nose_tip": "tip of the nose",
    "mouth_center": "middle of the mouth",
    "chin": "chin",
}
WORDS = {
    "photographs": "the photographs determine it",
    HARDLY: "it rests on the photographs, which hardly determine it",
    "exif": "it is EXIF's, adjusted",
    "expectation": "the photographs hardly determine it; it is what is usual for phones, adjusted",
}


def lens_trust(solution: Solution, views: list[PhotoView]) -> list[Trust]:
    """Focal length, distortion, principal point and distance of the camera."""
    scene, covariance = solution.adjusted.scene, solution.adjusted.covariance
    relative = float(np.sqrt(covariance[0, 0]))
    expected = solution.lens.log_focal_deviation
    source: Source = "photographs" if relative**2 < (1 - DETERMINED) * expected**2 else solution.focal_source
    focal = views[0].longer_side * float(np.exp(scene.log_focal))
    words = WORDS[rests_on(source, focal, relative * focal)]
    text = f"The focal length is {focal:.0f} px ± {relative:.0%}: {words}."
    found = [Trust("focal length", focal, relative * focal, "px", source, text)]
    if solution.lens.distortion_deviation:
        deviation = float(np.sqrt(covariance[1, 1]))
        text = f"The lens has radial distortion, k = {scene.distortion:.3f} ± {deviation:.3f}."
        found.append(Trust("distortion", scene.distortion, deviation, "", "photographs", text))
    else:
        text = "No distortion is modelled: the photographs do not determine one that differs from none."
        found.append(Trust("distortion", None, None, "", "assumption", text))
    text = "The principal point is taken to be the image's centre: faces cannot tell it from a turn of the camera."
    return [*found, Trust("principal point", None, None, "px", "assumption", text)]


def distance_trust(solution: Solution, views: list[PhotoView], depths: np.ndarray) -> list[Trust]:
    """The distance of each camera, which goes with the focal length; depths [V] in metres."""
    covariance, found = solution.adjusted.covariance, []
    for index, view in enumerate(views):
        size = LENS + POSE * index + 5
        gradient = np.zeros(len(covariance))
        gradient[0], gradient[size] = 1.0, -1.0
        relative = float(np.sqrt(gradient @ covariance @ gradient))
        text = f"'{view.id}' was taken from {depths[index]:.2f} m ± {relative:.0%}"
        text += ", as far as the focal length is known." if relative > 0.05 else "."
        value = 1e3 * float(depths[index])
        found.append(Trust(f"distance of {view.id}", value, relative * value, "mm", "photographs", text))
    return found


def scale_trust(options: PhotoOptions, eyes: float, deviation: float, source: Source) -> Trust:
    """The scale, by the distance of the outer eye corners and its deviation, metres."""
    why = {
        "expectation": "nothing but the size of faces sets the scale",
        "given": "by the known distance" if options.known_distance else "the given cameras are metric",
    }[source]
    text = f"The outer eye corners are {1e3 * eyes:.1f} ± {1e3 * deviation:.1f} mm apart: {why}."
    return Trust(SCALE, 1e3 * eyes, 1e3 * deviation, "mm", source, text)


def keypoint_trust(
    keypoints: np.ndarray, covariance: np.ndarray, from_photographs: np.ndarray
) -> list[Trust]:
    """The five keypoints: root mean square deviation of each, and what it rests on (share 1: no expected face)."""
    found = []
    for name, point, spread, share in zip(
        CANONICAL_KEYPOINTS, keypoints, covariance, from_photographs, strict=True
    ):
        if not np.isfinite(point).all():
            text = f"The {NAMES[name]} is not determined: too few photographs see it."
            found.append(Trust(name, None, None, "mm", "photographs", text))
            continue
        deviation = 1e3 * float(np.sqrt(np.trace(spread) / 3))
        source: Source = "photographs" if share >= 0.5 else "expectation"
        text = f"The {NAMES[name]} is known to {deviation:.1f} mm in each direction"
        text += f"; the photographs removed {share:.0%} of the variance among faces." if share < 1 else "."
        found.append(Trust(name, None, deviation, "mm", source, text))
    return found
