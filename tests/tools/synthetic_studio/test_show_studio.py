"""The page that shows a studio: what it says is what the capture and the truth hold."""

import json
import re
import shutil

import numpy as np
import pytest

import show_studio
from preface.artifacts import read_artifact
from preface.capture.rig import read_rig
from synthetic_studio.config import BoardConfig, StudioConfig
from synthetic_studio.writer import write_studio


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    output = tmp_path_factory.mktemp("made") / "studio"
    board = BoardConfig(frames=3)
    config = StudioConfig(output, identities=3, views=3, resolution="32x48", antialias=1, board=board, jobs=1)
    write_studio(config, "sphere_head")
    return output


@pytest.fixture
def studio(made, tmp_path):
    return shutil.copytree(made, tmp_path / "studio")


def blocks(studio, kind):
    twin = read_artifact(studio / "report.json", "preface/report")
    return [block for section in twin["sections"] for block in section["blocks"] if block["kind"] == kind]


def test_the_page_counts_what_the_capture_holds(studio, capsys):
    assert show_studio.main([str(studio)]) == 0
    assert capsys.readouterr().out.strip() == str(studio / "report.html")
    counts = {f["name"]: f["value"] for f in blocks(studio, "key_figures")[0]["figures"]}
    expected = {"people": 3, "cameras": 3, "takes": 2, "photographs": 9, "calibration images": 18}
    assert expected.items() <= counts.items()
    assert len(blocks(studio, "picture")) == 3


def test_the_page_may_have_another_name(studio, capsys):
    assert show_studio.main([str(studio), "--page", "studio.html"]) == 0
    assert capsys.readouterr().out.strip() == str(studio / "studio.html")
    assert not (studio / "report.html").exists()


def test_the_cameras_of_the_page_are_the_true_ones(studio):
    assert show_studio.main([str(studio)]) == 0
    rows = blocks(studio, "table")[-1]["rows"]
    rigs = [read_rig(studio / "truth" / "takes" / take / "rig.json") for take in ("take00", "take01")]
    assert [row["camera"] for row in rows] == list(rigs[0].cameras)
    for row in rows:
        first, second = (rig.cameras[row["camera"]].camera_from_rig.inverse.translation for rig in rigs)
        assert row["distance"] == pytest.approx(np.linalg.norm(first))
        assert row["drift"] == pytest.approx(1000 * np.linalg.norm(second - first))
        angles = np.radians([row["azimuth"], row["elevation"]])
        x, y, z = (
            np.sin(angles[0]) * np.cos(angles[1]),
            np.sin(angles[1]),
            np.cos(angles[0]) * np.cos(angles[1]),
        )
        np.testing.assert_allclose(np.array([x, y, z]) * row["distance"], first, atol=1e-12)


def test_only_the_people_asked_for_are_shown(studio):
    assert show_studio.main([str(studio), "--people", "2"]) == 0
    table = next(block for block in blocks(studio, "table") if "person" in block["rows"][0])
    assert [row["person"] for row in table["rows"]] == ["id0000", "id0001"]
    assert "2 of 3 people" in (studio / "report.html").read_text()


def test_a_missing_photograph_leaves_a_place_and_no_error(studio):
    assert show_studio.main([str(studio)]) == 0
    complete = blocks(studio, "picture")
    (studio / "capture/subjects/id0000/cam01.png").unlink()
    (studio / "capture/calibration/take00/cam02/frame000.png").unlink()
    assert show_studio.main([str(studio)]) == 0
    counts = {f["name"]: f["value"] for f in blocks(studio, "key_figures")[0]["figures"]}
    assert (counts["photographs"], counts["calibration images"]) == (8, 17)
    for before, after in zip(complete, blocks(studio, "picture"), strict=True):
        assert (before["width"], before["height"]) == (after["width"], after["height"])
        assert before["sha256"] != after["sha256"]


def test_the_same_studio_gives_the_same_page(studio):
    pages = []
    for _ in range(2):
        assert show_studio.main([str(studio)]) == 0
        pages.append((studio / "report.html").read_bytes())
    assert pages[0] == pages[1]


@pytest.mark.parametrize(
    "gone",
    [
        "capture/capture.json",
        "truth/takes/take00/rig.json",
        "truth/takes/take00/corners.npz",
        "truth/identities/id0000/head.json",
        "truth/identities/id0000/depth/cam00.exr",
    ],
)
def test_what_is_missing_is_named_and_no_page_is_left(studio, capsys, gone):
    (studio / gone).unlink()
    assert show_studio.main([str(studio)]) == 1
    message = capsys.readouterr().err
    assert all(part in message for part in gone.rsplit("/", 1))
    assert message.rstrip().endswith(".")  # with a remedy, as every message has
    assert not (studio / "report.html").exists()


def test_a_keypoint_behind_the_first_surface_is_drawn_as_hidden(studio):
    """The tip of the sphere's nose is in sight from the front; a point at its back never is."""
    path = studio / "truth/identities/id0000/head.json"
    head = json.loads(path.read_text())
    x, y, z = head["keypoints"]["nose_tip"]
    opened = show_studio.Studio(studio, show_studio.read_capture(studio / "capture"))
    rig = opened.rig("take00")

    def drawn(point):
        head["keypoints"] = {"nose_tip": point}
        path.write_text(json.dumps(head))
        tile, caption = next(show_studio.close_row(opened, "id0000", "cam00", rig))
        assert re.fullmatch("cam00 keypoints", caption)
        return {color for color in (show_studio.GREEN, show_studio.RED) if (tile == color).all(-1).any()}

    assert drawn([x, y, z]) == {show_studio.GREEN}
    assert drawn([x, y, z - 0.15]) == {show_studio.RED}
