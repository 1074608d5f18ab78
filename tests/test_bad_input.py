"""A table of bad input: each case ends in an error that names file, field and remedy, and leaves no trace."""

import errno
import json
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest
from PIL import Image

from preface.artifacts import MAX_JSON_BYTES, SCHEMA_DIRECTORY, ArtifactError
from preface.capture.images import read_image, write_exr, write_jpeg, write_png
from preface.capture.manifest import read_capture
from preface.cli.inspect import main
from preface.geometry.cameras import Camera
from preface.geometry.errors import GeometryError
from preface.geometry.similarity import fit_similarity, fit_similarity_robust
from preface.geometry.transforms import Rigid, Similarity

CAPTURE = {
    "schema": "preface/capture",
    "schema_version": 1,
    "cameras": [{"id": "front"}, {"id": "left", "width": 4, "height": 6}],
    "boards": [
        {
            "id": "board",
            "type": "charuco",
            "squares": [11, 8],
            "square_size": 0.022,
            "marker_size": 0.016,
            "dictionary": "DICT_5X5_50",
        }
    ],
    "takes": [{"id": "take1", "board": "board"}, {"id": "take2"}],
    "subjects": [{"id": "a", "take": "take1"}, {"id": "b", "take": "take2"}],
}
PIXELS = np.zeros((6, 4, 3), np.uint8)


@pytest.fixture
def folder(tmp_path):
    """A valid capture with a valid rig, for a case to break."""
    inside = tmp_path / "capture"
    for view in ("a/front", "a/left", "b/front", "b/left"):
        (inside / "subjects" / view).parent.mkdir(parents=True, exist_ok=True)
        write_png(inside / f"subjects/{view}.png", PIXELS)
    (inside / "capture.json").write_text(json.dumps(CAPTURE))
    shutil.copy(SCHEMA_DIRECTORY / "rig.example.json", inside / "rig.json")
    return inside


def contents(folder: Path) -> dict[str, bytes | None]:
    return {str(p): p.read_bytes() if p.is_file() else None for p in sorted(folder.parent.rglob("*"))}


@dataclass(frozen=True)
class Case:
    """How to break the folder, and what the error must name."""

    name: str
    break_it: Callable[[Path], object]
    file: str
    field: str
    remedy: str


def edit(file: str, *keys: str | int, value: object = None, remove: bool = False) -> Callable[[Path], None]:
    """Set or remove one value in a JSON file."""

    def apply(folder: Path) -> None:
        payload = json.loads((folder / file).read_text())
        place = payload
        for key in keys[:-1]:
            place = place[key]
        if remove:
            del place[keys[-1]]
        else:
            place[keys[-1]] = value
        (folder / file).write_text(json.dumps(payload))

    return apply


def replace(file: str, old: str, new: str) -> Callable[[Path], object]:
    return lambda folder: (folder / file).write_text((folder / file).read_text().replace(old, new, 1))


def content(file: str, data: bytes) -> Callable[[Path], object]:
    return lambda folder: (folder / file).write_bytes(data)


def capture(*keys, **change):
    return edit("capture.json", *keys, **change)


def rig(*keys, **change):
    return edit("rig.json", *keys, **change)


def all_of(*steps):
    return lambda folder: [step(folder) for step in steps]


def link(name: str, target: str) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        (folder.parent / "outside").mkdir(exist_ok=True)
        (folder.parent / "outside/left.png").write_bytes((folder / "subjects/a/front.png").read_bytes())
        path = folder / name
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
        path.symlink_to(target)

    return apply


def picture(mode: str, name: str = "subjects/a/front.tif", **options) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        (folder / "subjects/a/front.png").unlink()
        Image.new(mode, (4, 6)).save(folder / name, **options)

    return apply


def rotated(folder: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    picture("RGB", "subjects/a/front.jpg", exif=exif)(folder)


# fmt: off
MALFORMED = [
    Case("empty file", content("rig.json", b""), "rig.json", "line 1, column 1", "Correct the text"),
    Case("truncated", replace("rig.json", '"units": "metre",', '"units": "met'), "rig.json", "line 5",
         "Correct"),
    Case("cut off", lambda f: os.truncate(f / "rig.json", 300), "rig.json", "line 1",
         "copy or write it again"),
    Case("NaN", replace("rig.json", "13512.25", "NaN"), "rig.json", "number", "Write a finite number"),
    Case("Infinity", replace("rig.json", "13512.25", "-Infinity"), "rig.json", "number", "finite number"),
    Case("overflow", replace("rig.json", "13512.25", "1e400"), "rig.json", "number", "finite number"),
    Case("digits", replace("rig.json", "4096", "4" * 5000), "rig.json", "number", "Correct the number"),
    Case("key twice", replace("rig.json", '"take"', '"units": "metre", "take"'), "rig.json", "'units'",
         "Keep one"),
    Case("not UTF-8", content("rig.json", b'{"take": "\xff"}'), "rig.json", "byte 10",
         "Save the file as UTF-8"),
    Case("a list", content("rig.json", b"[1, 2]"), "rig.json", "file", "An artefact is one object"),
    Case("nested", content("rig.json", b"[" * 100_000), "rig.json", "file", "right file"),
    Case("huge", lambda f: os.truncate(f / "rig.json", MAX_JSON_BYTES + 1), "rig.json", "file", "right file"),
    Case("a folder", lambda f: ((f / "rig.json").unlink(), (f / "rig.json").mkdir()), "rig.json", "file",
         "Correct the path"),
    Case("dangling link", link("rig.json", "nowhere"), "rig.json", "file", "Correct the path"),
    Case("no schema", rig("schema", remove=True), "rig.json", "schema", "says 'preface/rig'"),
    Case("unknown schema", rig("schema", value="preface/rigg"), "rig.json", "schema", "says 'preface/rig'"),
    Case("schema a list", rig("schema", value=["preface/rig"]), "rig.json", "schema", "says 'preface/rig'"),
    Case("other schema", capture("schema", value="preface/rig"), "capture.json", "schema",
         "says 'preface/capture'"),
    Case("future version", rig("schema_version", value=2), "rig.json", "schema_version", "Upgrade preface"),
    Case("version text", rig("schema_version", value="1"), "rig.json", "schema_version",
         "version of this format"),
    Case("version true", rig("schema_version", value=True), "rig.json", "schema_version",
         "version of this format"),
    Case("version 0", rig("schema_version", value=0), "rig.json", "schema_version", "version of this format"),
    Case("no version", rig("schema_version", remove=True), "rig.json", "schema_version", "Add it"),
    Case("misspelt key", capture("takes", 0, "bord", value="x"), "capture.json", "takes[0].bord",
         "'board' was meant"),
    Case("missing key", capture("subjects", 1, "take", remove=True), "capture.json", "subjects[1].take",
         "Add it"),
    Case("wrong type", capture("cameras", value="front"), "capture.json", "cameras", "All cameras"),
    Case("no cameras", capture("cameras", value=[]), "capture.json", "cameras", "All cameras"),
    Case("unknown background", capture("takes", 0, "background", value="blakc"), "capture.json",
         "takes[0].background", "'black' was meant"),
    Case("fractional size", capture("cameras", 1, "width", value=4.5), "capture.json", "cameras[1].width",
         "pixels"),
    Case("zero size", capture("cameras", 1, "width", value=0), "capture.json", "cameras[1].width", "pixels"),
    Case("width alone", capture("cameras", 1, "height", remove=True), "capture.json", "cameras[1].height",
         "Add it"),
    Case("inch", rig("units", value="inch"), "rig.json", "units", "metre"),
    Case("short translation", rig("cameras", 0, "camera_from_rig", "translation", value=[0, 0]), "rig.json",
         "cameras[0].camera_from_rig.translation", "Three numbers"),
    Case("negative error", rig("cameras", 0, "reprojection_error", "rms", value=-1), "rig.json",
         "cameras[0].reprojection_error.rms", "Root mean square"),
]

CONTRADICTIONS = [
    Case("unknown take", capture("subjects", 1, "take", value="take7"), "capture.json", "subjects[1].take",
         "Correct the name or add the take"),
    Case("unknown board", capture("takes", 1, "board", value="x"), "capture.json", "takes[1].board",
         "add the board"),
    Case("subject twice", capture("subjects", 1, "id", value="a"), "capture.json", "subjects[1].id",
         "Give each a name"),
    Case("case only", capture("cameras", 1, "id", value="FRONT"), "capture.json", "cameras[1].id",
         "more than case"),
    Case("id with slash", capture("subjects", 0, "id", value="a/b"), "capture.json", "subjects[0].id",
         "letters, digits"),
    Case("id climbs", capture("subjects", 0, "id", value=".."), "capture.json", "subjects[0].id",
         "letters, digits"),
    Case("id hidden", capture("cameras", 0, "id", value=".front"), "capture.json", "cameras[0].id",
         "letters, digits"),
    Case("id NUL", capture("cameras", 0, "id", value="a\0"), "capture.json", "cameras[0].id",
         "letters, digits"),
    Case("id newline", capture("cameras", 0, "id", value="front\n"), "capture.json", "cameras[0].id",
         "letters, digits"),
    Case("id option", capture("cameras", 0, "id", value="-f"), "capture.json", "cameras[0].id",
         "letters, digits"),
    Case("id long", capture("cameras", 0, "id", value="f" * 101), "capture.json", "cameras[0].id",
         "100 at most"),
    Case("id surrogate", capture("cameras", 0, "id", value="\ud800"), "capture.json", "cameras[0].id",
         "letters"),
    Case("marker too big", capture("boards", 0, "marker_size", value=0.022), "capture.json",
         "boards[0].marker_size", "Measure both again"),
    Case("millimetres", capture("boards", 0, "square_size", value=22), "capture.json",
         "boards[0].square_size", "metres"),
    Case("few markers", capture("boards", 0, "squares", value=[12, 12]), "capture.json",
         "boards[0].dictionary", "Correct the dictionary or the squares"),
    Case("no dictionary", capture("boards", 0, "dictionary", remove=True), "capture.json",
         "boards[0].dictionary", "Add it"),
    Case("chessboard markers", capture("boards", 0, "type", value="chessboard"), "capture.json",
         "boards[0].marker_size", "Remove it"),
    Case("template camera", capture("layout", value={"images": "subjects/{identity}.png"}), "capture.json",
         "layout.images", "{camera}"),
    Case("template suffix", capture("layout", value={"masks": "m/{identity}/{camera}.txt"}), "capture.json",
         "layout.masks", "suffixes: .png"),
    Case("template brace", capture("layout", value={"images": "{take}/{identity}/{camera}.png"}),
         "capture.json", "layout.images", "Write it like"),
]

PATHS = [
    Case(f"path {name}", capture("takes", 0, key, value=path), "capture.json", f"takes[0].{key}",
         "inside the folder")
    for name, key, path in [
        ("absolute", "calibration", "/etc"),
        ("climbing", "calibration", "cal/../../x"),
        ("NUL", "calibration", "cal\0"),
        ("newline", "plates", "cal\n"),
        ("drive", "plates", "C:/cal"),
        ("backslash", "plates", "..\\cal"),
        ("surrogate", "plates", "\ud800"),
    ]
] + [
    Case("template climbs", capture("layout", value={"images": "../{identity}/{camera}.*"}), "capture.json",
         "layout.images", "inside the folder"),
    Case("folder link out", link("subjects/a", "../../outside"), "capture.json", "subjects[0]",
         "inside the folder"),
    Case("image link out", link("subjects/a/left.png", "../../../outside/left.png"), "capture.json",
         "subjects[0]", "inside the folder"),
    Case("link circle", all_of(link("loop", "loop"), capture("takes", 0, "plates", value="loop/x")),
         "capture.json", "takes[0].plates", "inside the folder"),
]

FILES = [
    Case("no image", lambda f: shutil.rmtree(f / "subjects/b"), "capture.json", "subjects[1]",
         "Add the images"),
    Case("two images", lambda f: shutil.copy(f / "subjects/a/left.png", f / "subjects/a/left.jpg"),
         "capture.json", "subjects[0]", "Keep one of them"),
    Case("no plates", capture("takes", 0, "background", value="plate"), "capture.json", "takes[0].plates",
         "Add"),
    Case("nothing there", lambda f: [shutil.rmtree(f), f.mkdir()], "capture", "folder", "Name an artefact"),
    Case("no such path", lambda f: shutil.rmtree(f), "capture", "file", "Correct the path"),
    Case("no subject inside",
         lambda f: [(f / "capture.json").unlink(), shutil.rmtree(f / "subjects"), (f / "subjects").mkdir()],
         "capture", "capture.json", "write a capture.json"),
]

IMAGES = [
    Case("no image file", content("subjects/a/front.png", b"GIF89a"), "front.png", "header",
         "Export the image as PNG"),
    Case("empty image", content("subjects/a/front.png", b""), "front.png", "header",
         "Export the image as PNG"),
    Case("half a header", lambda f: os.truncate(f / "subjects/a/front.png", 20), "front.png", "header",
         "Copy or export"),
    Case("rotated", rotated, "front.jpg", "EXIF orientation", "Turn the pixels"),
    Case("palette", picture("P"), "front.tif", "header", "grey, RGB or RGBA"),
    Case("CMYK", picture("CMYK", "subjects/a/front.jpg"), "front.jpg", "header", "grey, RGB or RGBA"),
    Case("bilevel", picture("1"), "front.tif", "header", "grey, RGB or RGBA"),
    Case("two pages", picture("L", save_all=True, append_images=[Image.new("L", (4, 6))]), "front.tif",
         "header", "a file of its own"),
    Case("wrong size", lambda f: write_png(f / "subjects/a/left.png", PIXELS[:5]), "left.png", "size",
         "one size"),
    Case("broken EXR",
         all_of(lambda f: (f / "subjects/a/front.png").unlink(),
                content("subjects/a/front.exr", b"\x76\x2f\x31\x01" + b"\xff" * 99)),
         "front.exr", "header", "Copy or export"),
]

CAMERAS = [
    Case("negative focal", rig("cameras", 0, "params", 0, value=-1.0), "rig.json", "cameras[0].params",
         "positive"),
    Case("zero focal", rig("cameras", 0, "params", 1, value=0), "rig.json", "cameras[0].params", "positive"),
    Case("few params", rig("cameras", 0, "params", value=[1000, 500, 500, 0, 0]), "rig.json",
         "cameras[0].params", "Correct it, or calibrate again"),
    Case("unknown model", rig("cameras", 0, "model", value="OPENCVV"), "rig.json", "cameras[0].model",
         "'OPENCV'"),
    Case("folds", rig("cameras", 0, "params", 4, value=-60.0), "rig.json", "cameras[0].params",
         "fewer coefficients"),
    Case("long quaternion", rig("cameras", 1, "camera_from_rig", "quaternion_wxyz", value=[1, 1, 0, 0]),
         "rig.json", "cameras[1].camera_from_rig.quaternion_wxyz", "Divide it by its length"),
    Case("zero quaternion", rig("cameras", 1, "camera_from_rig", "quaternion_wxyz", value=[0, 0, 0, 0]),
         "rig.json", "cameras[1].camera_from_rig.quaternion_wxyz", "Divide it by its length"),
    Case("no width", rig("cameras", 0, "width", value=0), "rig.json", "cameras[0].width", "pixels"),
    Case("camera twice", rig("cameras", 1, "id", value="front"), "rig.json", "cameras[1].id", "rename it"),
    Case("few deviations", rig("cameras", 0, "standard_deviations", "params", value=[1, 1, 1, 1]), "rig.json",
         "cameras[0].standard_deviations.params", "Give one per param"),
    Case("ragged covariance", rig("cameras", 0, "covariance", value=[[0.0] * 14] * 13), "rig.json",
         "cameras[0].covariance", "Give params, rotation, translation"),
]

# fmt: on

TABLE = [*MALFORMED, *CONTRADICTIONS, *PATHS, *FILES, *IMAGES, *CAMERAS]


@pytest.mark.parametrize("case", TABLE, ids=lambda case: case.name)
def test_bad_input_is_refused_with_file_field_and_remedy(folder, capsys, case):
    case.break_it(folder)
    before = contents(folder)
    assert main(["--json", str(folder)]) == 1
    output = json.loads(capsys.readouterr().out)
    problems = [problem for artifact in output["artifacts"] for problem in artifact["problems"]]
    assert len(problems) == 1, problems
    (problem,) = problems
    assert Path(problem["file"]).name == case.file
    assert problem["field"].startswith(case.field), problem
    assert case.remedy in problem["remedy"], problem
    assert problem["problem"]
    assert contents(folder) == before, "inspecting changed the folder"


@pytest.mark.parametrize("path", ["x" * 5000, "gone", "gone/gone"])
def test_a_path_that_cannot_exist_is_refused(tmp_path, capsys, path):
    assert main([str(tmp_path / path)]) == 1
    assert ": file: " in capsys.readouterr().err


def test_a_folder_that_may_not_be_listed_is_refused(folder, monkeypatch):
    def refuse(path):
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    monkeypatch.setattr(os, "scandir", refuse)
    with pytest.raises(ArtifactError, match=r"subjects/a: file: permission denied\. Correct the permissions"):
        read_capture(folder)


def test_a_file_of_an_unknown_kind_is_refused(folder, capsys):
    (folder / "other.json").write_text('{"schema": "preface/rigg"}')
    assert main([str(folder / "other.json")]) == 1
    assert "schema: 'preface/rigg' is not a kind of artefact" in capsys.readouterr().err


def test_the_unbroken_folder_is_valid(folder, capsys):
    assert main([str(folder)]) == 0
    assert capsys.readouterr().err == ""


def test_the_table_is_long_enough():
    assert len(TABLE) >= 40
    assert len({case.name for case in TABLE}) == len(TABLE)


# --------------------------------------------------------------------------- pixels that do not come


def halved(write):
    def make(path):
        write(path)
        os.truncate(path, path.stat().st_size // 2)

    return make


def integer_exr(path):
    with OpenEXR.File({}, {"Y": np.zeros((6, 4), np.uint32)}) as file:
        file.write(str(path))


NOISE = np.random.default_rng(0).integers(0, 256, (64, 48, 3)).astype(np.uint8)
UNREADABLE = {
    "half a PNG": ("a.png", halved(lambda p: write_png(p, NOISE)), "pixels", "Copy or export"),
    "half a JPEG": ("a.jpg", halved(lambda p: write_jpeg(p, NOISE, 90)), "pixels", "Copy or export"),
    "half a TIFF": ("a.tif", halved(lambda p: cv2.imwrite(str(p), NOISE)), "", "Copy or export"),
    "half an EXR": (
        "a.exr",
        halved(lambda p: write_exr(p, {"Y": NOISE[..., 0].astype(np.float32)})),
        "pixels",
        "Copy",
    ),
    "integer EXR": ("a.exr", integer_exr, "channel Y", "half or float"),
    "depth as colour": (
        "a.exr",
        lambda p: write_exr(p, {"Z": np.zeros((2, 2), np.float32)}),
        "channels",
        "R G B",
    ),
    "half and float": (
        "a.exr",
        lambda p: write_exr(p, {c: np.zeros((2, 2), np.float16 if c == "R" else np.float32) for c in "RGB"}),
        "channels",
        "all half or all float",
    ),
    "no file": ("a.png", lambda p: None, "file", "Correct the path"),
    "a folder": ("a.png", lambda p: p.mkdir(), "file", "names a folder"),
}


@pytest.mark.filterwarnings("ignore:Corrupt EXIF data", "ignore:Truncated File Read")
@pytest.mark.parametrize("name", UNREADABLE)
def test_an_image_that_cannot_be_decoded_is_refused(tmp_path, name):
    file, make, field, remedy = UNREADABLE[name]
    make(tmp_path / file)
    with pytest.raises(ArtifactError) as caught:
        read_image(tmp_path / file)
    assert caught.value.path == tmp_path / file
    assert caught.value.field.startswith(field)
    assert remedy in caught.value.remedy


# ------------------------------------------------------------------------------ impossible geometry

LINE = np.outer(np.arange(5.0), [1, 2, 3])
CLOUD = np.random.default_rng(0).normal(size=(5, 3))
GEOMETRY = {
    "two points": (lambda: fit_similarity(CLOUD[:2], CLOUD[:2]), "source", "takes three or more"),
    "no points": (lambda: fit_similarity(CLOUD[:0], CLOUD[:0]), "source", "takes three or more"),
    "collinear source": (lambda: fit_similarity(LINE, CLOUD), "source", "add a point off the line"),
    "collinear target": (lambda: fit_similarity(CLOUD, LINE), "target", "add a point off the line"),
    "coincident": (lambda: fit_similarity(np.ones((5, 3)), CLOUD), "source", "form a triangle"),
    "coincident far off": (lambda: fit_similarity(CLOUD, np.full((5, 3), 1e6)), "target", "form a triangle"),
    "NaN point": (lambda: fit_similarity(np.where(CLOUD > 1, np.nan, CLOUD), CLOUD), "source", "weight 0"),
    "unequal counts": (lambda: fit_similarity(CLOUD, CLOUD[:4]), "source, target", "(n, 3)"),
    "negative weight": (lambda: fit_similarity(CLOUD, CLOUD, -np.ones(5)), "weights", ">= 0"),
    "two weighted": (lambda: fit_similarity(CLOUD, CLOUD, np.eye(5)[0]), "source", "three or more"),
    "zero threshold": (lambda: fit_similarity_robust(CLOUD, CLOUD, 0.0), "threshold", "positive distance"),
    "mirrored matrix": (lambda: Rigid(np.diag([1.0, 1, -1]), np.zeros(3)), "rotation", "negate it"),
    "scaled matrix": (lambda: Rigid(2 * np.eye(3), np.zeros(3)), "rotation", "is a Similarity"),
    "sheared matrix": (
        lambda: Rigid(np.eye(3) + np.eye(3, k=1), np.zeros(3)),
        "rotation",
        "rows and columns",
    ),
    "NaN matrix": (lambda: Rigid(np.full((3, 3), np.nan), np.zeros(3)), "rotation", "finite"),
    "negative scale": (lambda: Similarity(np.array(-1.0), np.eye(3), np.zeros(3)), "scale", "positive"),
    "NaN camera": (
        lambda: Camera("PINHOLE", 4, 4, np.array([1.0, 1, np.nan, 2])),
        "params",
        "must be finite",
    ),
    "half a pixel": (lambda: Camera("PINHOLE", 4.5, 4, np.ones(4)), "width", "whole number"),
}


@pytest.mark.parametrize("name", GEOMETRY)
def test_impossible_geometry_is_refused_with_field_and_remedy(name):
    make, field, remedy = GEOMETRY[name]
    with pytest.raises(GeometryError) as caught:
        make()
    assert str(caught.value).startswith(field)
    assert remedy in str(caught.value)
