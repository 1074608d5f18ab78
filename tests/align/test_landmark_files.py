"""Landmark files: exact round trips, what may be left out, and errors that name file, field and remedy."""

import json
from dataclasses import replace

import numpy as np
import pytest

from preface.align.keypoints import SCHEMES
from preface.align.landmark_files import (
    landmark_file,
    read_landmark_folder,
    read_landmarks,
    write_landmarks,
)
from preface.align.landmarks import NoFace, ViewLandmarks, box_around
from preface.artifacts import SCHEMA_DIRECTORY, ArtifactError

VIEW = ("anna", "front")
SIZE = (640, 480)


def made_up(scheme):
    """Landmarks anywhere in the image, the third of them not seen."""
    rng = np.random.default_rng(3)
    count = SCHEMES[scheme].size
    pixels = rng.uniform([0, 0], SIZE, (count, 2))
    sigma, confidence = rng.uniform(0.5, 2, count), rng.uniform(0, 1, count)
    pixels[2], sigma[2], confidence[2] = np.nan, np.nan, 0.0
    warnings = ("It is dark.",)
    return ViewLandmarks(scheme, pixels, sigma, confidence, box_around(pixels), -12.5, 1, warnings)


@pytest.fixture
def content():
    """A valid file, as any program may write it."""
    pixels = np.random.default_rng(4).uniform([0, 0], SIZE, (68, 2)).round(2).tolist()
    return {
        "schema": "preface/landmarks",
        "schema_version": 1,
        "subject": VIEW[0],
        "camera": VIEW[1],
        "width": SIZE[0],
        "height": SIZE[1],
        "scheme": "ibug68",
        "pixels": pixels,
    }


@pytest.fixture
def path(tmp_path):
    file = landmark_file(tmp_path, VIEW)
    file.parent.mkdir()
    return file


@pytest.mark.parametrize("scheme", SCHEMES)
def test_what_is_written_is_read(path, scheme):
    landmarks = made_up(scheme)
    write_landmarks(path, VIEW, SIZE, landmarks)
    again = read_landmarks(path, VIEW, SIZE)
    assert isinstance(again, ViewLandmarks)
    for name in ("pixels", "sigma", "confidence", "face_box"):
        np.testing.assert_allclose(getattr(again, name), getattr(landmarks, name), atol=1e-4)
    assert (again.scheme, again.rotation, again.others) == (scheme, -12.5, 1)
    assert again.warnings == landmarks.warnings
    assert again.seen.sum() == SCHEMES[scheme].size - 1


def test_a_view_without_a_face_keeps_its_reason(path):
    write_landmarks(path, VIEW, SIZE, NoFace("seen from behind"))
    assert read_landmarks(path, VIEW, SIZE) == NoFace("seen from behind")


def test_only_pixels_are_needed(path, content):
    content["pixels"][5] = None
    content["pixels"][6] = [None, None]
    path.write_text(json.dumps(content))
    landmarks = read_landmarks(path, VIEW, SIZE)
    assert np.flatnonzero(~landmarks.seen).tolist() == [5, 6]
    assert np.isnan(landmarks.sigma[5:7]).all()
    assert landmarks.confidence[5:7].tolist() == [0, 0]
    assert landmarks.confidence[0] == 1
    side = (landmarks.face_box[2:] - landmarks.face_box[:2]).max()
    np.testing.assert_allclose(landmarks.sigma[landmarks.seen], 0.005 * side)


def test_the_example_is_a_face():
    landmarks = read_landmarks(SCHEMA_DIRECTORY / "landmarks.example.json", ("anna", "front"), (1024, 1024))
    right, left, nose, mouth, chin = landmarks.keypoints
    assert right[0] < nose[0] < left[0]
    assert right[1] < nose[1] < mouth[1] < chin[1]


def with_pixel(entry):
    return lambda content: content["pixels"].__setitem__(7, entry)


REFUSED = {
    "wrong count": (lambda c: c["pixels"].pop(), r"pixels: has 67 entries, but the scheme ibug68 has 68"),
    "other scheme": (
        lambda c: c.update(scheme="facemesh478"),
        r"pixels: has 68 entries, but the scheme facemesh478 has 478",
    ),
    "unknown scheme": (lambda c: c.update(scheme="wflw98"), r"scheme: .*wflw98.*facemesh478"),
    "outside": (
        with_pixel([640.2, 5]),
        r"pixels\[7\]: \(640.2, 5\) lies outside the image of 640x480 .*null",
    ),
    "negative": (with_pixel([3, -1]), r"pixels\[7\]: \(3, -1\) lies outside"),
    "half given": (with_pixel([3, None]), r"pixels\[7\]: is neither a pair of numbers nor null.*null for"),
    "three numbers": (with_pixel([1, 2, 3]), r"pixels\[7\]: is neither"),
    "text": (with_pixel(["1", "2"]), r"pixels\[7\]: is neither"),
    "infinite": (with_pixel([float("inf"), 2]), r"number: .*Infinity"),
    "nan": (with_pixel([float("nan"), 2]), r"number: .*NaN.*Write null for a landmark that is not seen"),
    "nothing seen": (lambda c: c.update(pixels=[None] * 68), r'pixels: not one landmark is seen.*"no_face"'),
    "sigma missing": (lambda c: c.update(sigma=[1.0] * 67 + [None]), r"sigma\[67\]: is no number, but"),
    "sigma short": (lambda c: c.update(sigma=[1.0]), r"sigma: has 1 entries"),
    "sigma zero": (lambda c: c.update(sigma=[0] + [1] * 67), r"sigma\[0\]: .*more than 0"),
    "confidence": (lambda c: c.update(confidence=[2.0] + [1] * 67), r"confidence\[0\]: .*at most 1"),
    "one place": (
        lambda c: c.update(pixels=[[5, 5]] * 68),
        r"sigma: is missing, and all landmarks lie in one place",
    ),
    "image size": (lambda c: c.update(width=641), r"width and height: are 641x480, but the image is 640x480"),
    "other person": (lambda c: c.update(subject="berta"), r"subject: is 'berta', but .*'anna'"),
    "other camera": (lambda c: c.update(camera="left"), r"camera: is 'left', but .*'front'"),
    "both": (lambda c: c.update(no_face="hidden"), r"no_face|pixels|scheme|sigma"),
    "no pixels": (lambda c: c.pop("pixels"), r"pixels"),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_bad_files_are_refused_by_place_and_remedy(path, content, kind):
    spoil, message = REFUSED[kind]
    spoil(content)
    path.write_text(json.dumps(content))
    with pytest.raises(ArtifactError, match=message) as error:
        read_landmarks(path, VIEW, SIZE)
    assert error.value.path == path
    assert error.value.remedy


def test_a_folder_gives_every_view_its_landmarks(tmp_path, path):
    other = ("anna", "left")
    write_landmarks(path, VIEW, SIZE, made_up("ibug68"))
    found = read_landmark_folder(tmp_path, {VIEW: SIZE, other: SIZE})
    assert list(found) == [VIEW, other]
    assert isinstance(found[VIEW], ViewLandmarks)
    assert isinstance(found[other], NoFace)
    assert "left.json" in found[other].reason


def test_a_folder_of_two_schemes_is_refused(tmp_path, path):
    write_landmarks(path, VIEW, SIZE, made_up("ibug68"))
    other = ("anna", "left")
    write_landmarks(landmark_file(tmp_path, other), other, SIZE, made_up("facemesh478"))
    with pytest.raises(
        ArtifactError, match=r"left\.json: scheme: is facemesh478, but that of .*front\.json is ibug68"
    ):
        read_landmark_folder(tmp_path, {VIEW: SIZE, other: SIZE})


def test_a_folder_without_any_of_the_views_is_refused(tmp_path):
    with pytest.raises(ArtifactError, match=r"no file with landmarks.*anna/front\.json"):
        read_landmark_folder(tmp_path, {VIEW: SIZE})


def test_landmarks_that_are_not_finite_are_not_written(path):
    landmarks = made_up("ibug68")
    spoilt = replace(landmarks, sigma=np.full(68, np.inf))
    with pytest.raises(ArtifactError, match="sigma"):
        write_landmarks(path, VIEW, SIZE, spoilt)
    assert not path.exists()
