"""Which method is chosen for a take, and why; and the methods' common interface."""

import builtins

import numpy as np
import pytest
from drawn_person import GREEN, person, photograph, screen

from preface.artifacts import ArtifactError
from preface.capture.foreground import METHODS, ForegroundError, Hints, choose, hints_of, make_segmenter
from preface.capture.images import write_png
from preface.capture.manifest import CaptureCamera, Manifest, Subject, Take, read_capture, write_capture

CAMERAS = ("left", "right")


@pytest.fixture
def capture(tmp_path):
    """Writes a capture of one person before a background, with masks and plates of some cameras."""

    def write(declared, behind, masks=(), plates=()):
        alpha, light = person(60, 40)
        cameras = tuple(CaptureCamera(name) for name in CAMERAS)
        for folder in ("subjects/anna", "masks/anna", "background"):
            (tmp_path / folder).mkdir(parents=True)
        manifest = Manifest(cameras, (Take("monday", background=declared),), (Subject("anna", "monday"),))
        for name in CAMERAS:
            write_png(tmp_path / f"subjects/anna/{name}.png", photograph(alpha, light, behind))
        for name in masks:
            write_png(tmp_path / f"masks/anna/{name}.png", np.rint(alpha * 255).astype(np.uint8))
        for name in plates:
            write_png(tmp_path / f"background/{name}.png", photograph(0 * alpha, light, behind))
        write_capture(tmp_path, manifest)
        return read_capture(tmp_path)

    return write


BLACK = np.zeros((60, 40, 3))
ROOM = np.full((60, 40, 3), 0.3)


@pytest.mark.parametrize(
    ("declared", "behind", "masks", "plates", "method", "words"),
    [
        ("green", screen(60, 40, 0.1), CAMERAS, (), "given", "all 2 photographs have a mask"),
        ("black", BLACK, (), (), "black", "monday says that its background is black"),
        ("green", screen(60, 40, 0.1), (), CAMERAS, "green", "says that its background is green"),
        ("unknown", ROOM, (), CAMERAS, "plate", "clean plates of all 2 cameras"),
        ("unknown", BLACK, (), (), "black", "the border of 2 of 2 photographs looked at is black"),
        ("unknown", screen(60, 40, 0.1, GREEN), (), (), "green", "is green"),
        ("unknown", ROOM, (), (), "selfie", "neither black nor green"),
        ("unknown", ROOM, (), ("left",), "selfie", "neither black nor green"),
    ],
)
def test_auto_says_which_and_why(capture, declared, behind, masks, plates, method, words):
    choice = choose(capture(declared, behind, masks, plates), "monday")
    assert choice.method == method
    assert words in choice.reason


def test_some_masks_are_used_and_the_others_found(capture):
    found = capture("black", BLACK, masks=("left",))
    choice = choose(found, "monday")
    assert (choice.method, choice.given_first, choice.background_kind) == ("black", True, "black")
    assert "1 of 2 photographs have a mask" in choice.reason
    segmenter = choice.segmenter()
    methods = []
    for camera in CAMERAS:
        hints = hints_of(found, "monday", "anna", camera)
        methods.append(segmenter(np.zeros((60, 40, 3), np.uint8), hints).method)
    assert methods == ["given", "black"]


@pytest.mark.parametrize(
    ("method", "words"),
    [("given", "2 of 2 photographs"), ("plate", "no clean plate of left, right"), ("onnx", "none was given")],
)
def test_a_method_without_its_files_is_refused(capture, method, words):
    with pytest.raises(ArtifactError, match=words):
        choose(capture("unknown", ROOM), "monday", method)


def test_a_declared_plate_that_a_camera_lacks_is_refused(capture):
    with pytest.raises(ArtifactError, match="no clean plate of right"):
        choose(capture("plate", ROOM, plates=("left",)), "monday")


def test_unknown_names_are_refused(capture):
    found = capture("unknown", ROOM)
    with pytest.raises(ValueError, match="neither 'auto' nor one of given"):
        choose(found, "monday", "magic")
    with pytest.raises(ValueError, match="not a take"):
        choose(found, "tuesday")


@pytest.mark.parametrize(
    ("mask", "expected"),
    [
        (np.array([[0, 255]], np.uint8), [0, 1]),
        (np.array([[0, 1]], np.uint8), [0, 1]),
        (np.array([[0, 51]], np.uint8).repeat(2, 0)[:1], [0, 1]),
        (np.array([[51, 255]], np.uint8), [0.2, 1]),
        (np.array([[13107, 65535]], np.uint16), [0.2, 1]),
        (np.array([[False, True]]), [0, 1]),
        (np.array([[0.25, 0.5]], np.float32), [0.25, 0.5]),
        (np.array([[[0, 0, 0], [255, 255, 255]]], np.uint8), [0, 1]),
        (np.array([[[9, 9, 9, 0], [9, 9, 9, 255]]], np.uint8), [0, 1]),
    ],
)
def test_masks_of_every_kind_are_read_as_coverage(mask, expected):
    found = make_segmenter("given")(np.zeros((1, 2, 3), np.uint8), Hints(mask=mask))
    np.testing.assert_allclose(found.alpha, [expected], atol=1e-6)


@pytest.mark.parametrize(
    ("mask", "words"),
    [
        (None, "mask: is missing"),
        (np.zeros((3, 2), np.uint8), "mask: has 2x3 pixels, and the photograph has 2x1"),
        (np.array([[[0, 0, 9], [1, 2, 3]]], np.uint8), "coloured"),
        (np.array([[0.0, 7.0]], np.float32), r"outside \[0, 1\]"),
    ],
)
def test_masks_that_mean_nothing_are_refused(mask, words):
    with pytest.raises(ForegroundError, match=words):
        make_segmenter("given")(np.zeros((1, 2, 3), np.uint8), Hints(mask=mask))


def test_an_images_own_alpha_is_its_mask():
    pixels = np.zeros((1, 2, 4), np.uint8)
    pixels[0, 1, 3] = 255
    np.testing.assert_array_equal(make_segmenter("given")(pixels, Hints()).alpha, [[0, 1]])


def test_none_takes_everything():
    assert make_segmenter("none")(np.zeros((2, 3, 1), np.uint8), Hints()).alpha.min() == 1


@pytest.mark.parametrize("method", [name for name in METHODS if name not in ("onnx", "selfie")])
def test_what_is_no_image_is_refused(method):
    with pytest.raises(ForegroundError, match="pixels"):
        make_segmenter(method)(np.zeros((2, 2, 2), np.int32), Hints())


def test_selfie_without_mediapipe_says_how_to_install_it(monkeypatch):
    real = builtins.__import__

    def without(name, *rest, **named):
        if name.startswith("mediapipe"):
            raise ImportError("No module named 'mediapipe'")
        return real(name, *rest, **named)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ForegroundError, match=r"tools/setup\.sh"):
        make_segmenter("selfie")
