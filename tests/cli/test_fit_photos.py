"""``preface-fit`` on photographs: what comes before the fit, and what is said of the result."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import made_up_studio as made
import numpy as np
import pytest

from preface.align.alignment_files import TEMPLATE_FILE, AlignmentIndex, write_index, write_template
from preface.align.keypoints import FACEMESH478
from preface.align.landmark_files import landmark_file, write_landmarks
from preface.align.landmarks import ViewLandmarks, box_around
from preface.align.photos.face import face_prior, keypoint_weights
from preface.align.photos.views import HARDLY
from preface.artifacts import ArtifactError, load_json, provenance
from preface.capture.images import write_png
from preface.capture.rig import write_rig
from preface.cli import build_shards
from preface.cli.fit import main, parse
from preface.cli.fit_photos import expected_template, is_aligned, photographs, prepare, view_size
from preface.cli.fit_trust import directions, trust, widest_angle
from preface.cli.usage import UsageError
from preface.model.configuration import PRESETS
from preface.model.training.prior_files import Prior, Scene
from preface.reports import Report
from preface.shards import Dataset
from preface.shards.building import build_manifest
from preface.shards.writer import ShardWriter

sys.path.insert(0, str(Path(__file__).parents[1] / "model" / "training"))

ANGLES = {"a": -15.0, "b": 15.0}
FIT = ["--prior", "none", "--device", "cpu", "--quality", "draft", "--finetuning.steps", "2"]
FIT += ["--finetuning.rays", "16", "--finetuning.normals", "0", "--model.nerf.width", "16"]
FIT += ["--model.nerf.depth", "2", "--model.samples", "6", "4", "--photos.resolution", "16x24"]


@pytest.fixture
def person(tmp_path):
    """Two photographs of the expected face in front of grey, with all that another program could have found."""
    rig = made.rig(tuple(ANGLES), tuple(ANGLES.values()), "phone")
    write_rig(tmp_path / "cameras.json", rig)
    rows, columns = np.mgrid[: made.SIZE[1], : made.SIZE[0]]
    disc = np.hypot(columns - made.SIZE[0] / 2, (rows - made.SIZE[1] / 2) / 1.3) < 90
    for folder in ("me", "masks"):
        (tmp_path / folder).mkdir()
    for name, entry in rig.cameras.items():
        image = np.where(disc[..., None], [200, 150, 120], 90).astype(np.uint8)
        write_png(tmp_path / "me" / f"{name}.png", image)
        write_png(tmp_path / "masks" / f"{name}.png", 255 * disc.astype(np.uint8))
        pixels, _ = entry.camera.project(entry.camera_from_rig.apply(face_prior().mean))
        count = FACEMESH478.size
        found = ViewLandmarks(
            FACEMESH478.name, pixels, np.full(count, 0.5), np.ones(count), box_around(pixels)
        )
        path = landmark_file(tmp_path / "landmarks", ("me", name))
        path.parent.mkdir(parents=True, exist_ok=True)
        write_landmarks(path, ("me", name), made.SIZE, found)
    return tmp_path / "me"


def words(person, *more):
    root = person.parent
    given = {"cameras": "cameras.json", "landmarks": "landmarks", "masks": "masks"}
    flags = [word for name, file in given.items() for word in (f"--photos.{name}", root / file)]
    return [str(word) for word in (person, "--output", root / "head", *flags, *FIT, *more)]


def prior_of(resolution, box=((-0.2, -0.25, -0.25), (0.2, 0.25, 0.12)), folder=None):
    scene = Scene(np.array(box), (0.5, 1.5), 4.0, resolution)
    return Prior(folder, PRESETS["tiny"], ("x",), scene, {}, 1, 1, {}, {}, "", {}, {})


# ---------------------------------------------------------------------------------------- end to end


def test_photographs_become_a_head_in_one_command(person, capsys, monkeypatch):
    light = lambda *_: Report("light", {})  # noqa: E731 - the pages of other commands are not tried here
    monkeypatch.setattr("preface.cli.align_photos.photo_report", light)
    assert main(words(person)) == 0
    head = person.parent / "head"
    printed = capsys.readouterr()
    assert printed.out.splitlines() == [str(head / "model.json")]
    for part in ("1 of 3", "preface-align photos", "2 of 3", "preface-build-shards", "3 of 3", "How far to"):
        assert part in printed.err
    fit = load_json(head / "model.json")["fit"]
    assert (fit["identity"], fit["views"]) == ("me", ["a", "b"])
    assert fit["resolution"] == {"width": 16, "height": 24}
    assert load_json(head / "photos" / "trust.json")["schema"] == "preface/report"
    with Dataset(head / "photos" / "shards") as shards:
        # The face of the photographs is the expected one: it is where everybody's is expected.
        np.testing.assert_allclose(shards.tables["keypoints"][0], expected_template().keypoints, atol=2e-4)
    assert main(words(person)) == 0
    assert "are taken already" in capsys.readouterr().err


def test_a_stage_that_fails_ends_the_command_with_its_status(person, capsys):
    (person.parent / "masks" / "a.png").unlink()
    status = main(words(person, "--photos.resolution", "4000x6000"))
    assert status == 1
    printed = capsys.readouterr()
    assert "enlarging adds none" in printed.err
    assert printed.out == ""


# ------------------------------------------------------------------------------------- what is asked


def test_one_to_seven_photographs_are_taken(tmp_path):
    with pytest.raises(ArtifactError, match="holds neither shards"):
        photographs(tmp_path, ())
    for name in range(9):
        (tmp_path / f"p{name}.jpg").touch()
    (tmp_path / "notes.txt").touch()
    with pytest.raises(ArtifactError, match=r"there are 9, .*--views p0 p4 p8"):
        photographs(tmp_path, ())
    assert [f.name for f in photographs(tmp_path, ("p7", "p2"))] == ["p2.jpg", "p7.jpg"]
    with pytest.raises(ArtifactError, match="no photograph 'p9'"):
        photographs(tmp_path, ("p9",))


@pytest.mark.parametrize(
    ("photo", "quality", "asked", "expected"),
    [
        ((135, 240), "balanced", "auto", (24, 36)),
        ((135, 240), "paper", "auto", (5 * 24, 5 * 36)),
        ((1000, 750), "paper", "auto", (8 * 24, 8 * 36)),
        ((12, 160), "paper", "auto", (12, 18)),
        ((135, 240), "paper", "50x60", (50, 60)),
    ],
)
def test_views_have_the_size_that_suits_the_prior_and_the_photographs(
    tmp_path, photo, quality, asked, expected
):
    files = [tmp_path / "small.png", tmp_path / "large.png"]
    for file, factor in zip(files, (1, 2), strict=True):
        write_png(file, np.zeros((factor * photo[1], factor * photo[0], 3), np.uint8))
    command = parse(["photos", "--quality", quality, "--photos.resolution", asked])
    assert view_size(command, prior_of((24, 36)), files) == expected


def test_a_resolution_that_is_none_is_wrong_usage():
    with pytest.raises(UsageError, match="is not WIDTHxHEIGHT"):
        view_size(parse(["photos", "--photos.resolution", "big"]), None, [])


def test_shards_get_the_box_of_the_prior_to_the_last_bit(person, monkeypatch, tmp_path):
    box = ((-0.1 - 1e-16, -1 / 3, -0.25), (0.2, 0.1 + 0.2, 0.12))
    prior = prior_of((12, 18), box, tmp_path / "prior" / "model.json")
    (tmp_path / "prior").mkdir()
    template = write_template(tmp_path / "prior" / TEMPLATE_FILE, expected_template())
    seen = {}
    monkeypatch.setattr("preface.cli.fit_photos.read_prior", lambda _: prior)
    monkeypatch.setattr(
        "preface.cli.align.main", lambda given: seen.setdefault("align", given) and 1
    )  # and stop there
    command = parse([str(person), "--prior", str(tmp_path / "prior"), "--output", str(tmp_path / "head")])
    with pytest.raises(Exception, match="exit status 1"):
        prepare(command, lambda _: None)
    assert seen["align"][seen["align"].index("--template") + 1] == str(template)
    from preface.cli.fit_photos import _shards_words

    given = _shards_words(parse([str(person)]), prior, (12, 18), tmp_path, tmp_path / "shards")
    chosen = build_shards._parser().parse_args(given)
    assert chosen.box == [*box[0], *box[1]]
    assert (chosen.resolution, chosen.framing) == ((12, 18), "box")


def test_an_alignment_is_kept_for_the_same_photographs_only(tmp_path):
    files = [tmp_path / "a.png", tmp_path / "b.png"]
    for number, file in enumerate(files):
        file.write_bytes(bytes([number]))
    template = write_template(tmp_path / TEMPLATE_FILE, expected_template())
    assert not is_aligned(tmp_path, files, template, None)
    inputs = {"given template": template, **{f"me/{file.stem}/{file.name}": file for file in files}}
    index = AlignmentIndex("facemesh478", (), (), (), provenance({}, inputs))
    write_index(tmp_path, index)
    assert is_aligned(tmp_path, files, template, None)
    assert not is_aligned(tmp_path, files[:1], template, None)
    assert not is_aligned(tmp_path, files, template, files[0])
    files[1].write_bytes(b"another picture")
    assert not is_aligned(tmp_path, files, template, None)


def test_expected_template_is_the_expected_face_in_its_own_frame():
    template = expected_template()
    np.testing.assert_allclose(template.keypoints, keypoint_weights() @ face_prior().mean, atol=1.5e-3)
    np.testing.assert_allclose(template.keypoints.mean(axis=0), 0, atol=1e-12)
    assert ((template.spread > 1e-3) & (template.spread < 2e-2)).all()


# --------------------------------------------------------------------------------------------- trust


def test_directions_and_angles_are_those_of_the_subject():
    left, right, above = np.array([1.0, 0, 1]), np.array([-1.0, 0, 1]), np.array([0, 2.0, 2.0])
    azimuth, elevation = np.degrees(directions(np.stack([left, right, above])))
    np.testing.assert_allclose(azimuth, [45, -45, 0])
    np.testing.assert_allclose(elevation, [0, 0, 45], atol=1e-12)
    assert np.degrees(widest_angle(np.stack([left, right]))) == pytest.approx(90)
    assert widest_angle(left[None]) == 0


def alignment_report(folder, rows):
    (folder / "alignment").mkdir()
    table = {"kind": "table", "rows": rows}
    content = {"sections": [{"heading": "x", "blocks": [{"kind": "text"}, table]}]}
    (folder / "alignment" / "report.json").write_text(json.dumps(content))
    return folder / "alignment"


def test_trust_tells_what_is_settled_from_what_is_expected(ball, tmp_path):
    rows = [
        {"what": "focal length", "value": 1000.0, "±": 200.0, "unit": "px", "rests on": "expectation"},
        {"what": "distance of a", "value": 500.0, "±": 10.0, "unit": "mm", "rests on": "photographs"},
        {"what": "distance of b", "value": 500.0, "±": 100.0, "unit": "mm", "rests on": HARDLY},
        {"what": "chin", "value": None, "±": 2.0, "unit": "mm", "rests on": "photographs"},
        {"keypoint": "chin", "from the photographs": 60.0},
    ]
    found = trust(alignment_report(tmp_path, rows), ball, tmp_path / "views.png", from_prior=False)
    assert found.numbers == (
        "Settled by the photographs: distance of a 500 ± 10 mm; chin to 2.0 mm.",
        "From what is usual of faces and of phones: focal length 1000 ± 200 px.",
        "Hardly settled by the photographs: distance of b 500 ± 100 mm.",
        "Of what differs among faces in eyes, nose, mouth and chin, the photographs settle 60% to 60%; the expected "
        "face stands for the rest.",
    )
    assert found.views[0].startswith("6 views, from 46° to the subject's right to 46° to the subject's left")
    assert "there is no prior" in found.views[1]
    assert any("contradicts the others by 30%" in sentence for sentence in found.masks)
    assert "a note" in found.masks[-1]


def test_a_damaged_report_is_named(ball, tmp_path):
    folder = alignment_report(tmp_path, [])
    (folder / "report.json").write_text('{"sections": 3}')
    with pytest.raises(ArtifactError, match="is not a report"):
        trust(folder, ball, tmp_path / "views.png", from_prior=True)


def test_trust_is_a_page_with_the_head_the_views_and_links_to_what_it_sums_up(ball, tmp_path):
    write_png(tmp_path / "views.png", np.full((20, 60, 3), 90, np.uint8))
    found = trust(alignment_report(tmp_path, []), ball, tmp_path / "views.png", from_prior=True)
    assert [name for _, name in found.thumbnails] == [f"camera{view}" for view in range(6)]
    twin = load_json(found.report({}, tmp_path).write(tmp_path / "trust.html").with_suffix(".json"))
    blocks = [block for section in twin["sections"] for block in section["blocks"]]
    pictures = [block for block in blocks if block["kind"] == "picture"]
    assert (pictures[0]["width"], pictures[0]["height"]) == (60, 20)
    assert "24x32 pixels" in pictures[1]["caption"]
    links = [link["path"] for block in blocks if block["kind"] == "links" for link in block["links"]]
    assert links == ["alignment/report.html", "balls/masks.html"]


@pytest.fixture
def ball(tmp_path):
    """A dataset of one ball-shaped head whose masks have figures, one of them bad."""
    import ball_heads

    (tmp_path / "balls").mkdir()
    masks = {
        f"camera{view}": {"method": "selfie", "share": 0.5, "soft": 0.1, "disagreement": 0.02}
        for view in range(6)
    }
    masks["camera3"] |= {"disagreement": 0.3, "flagged": True}
    metadata = {"masks": masks, "remarks": {"camera3": ["a note"]}}
    with ShardWriter(tmp_path / "balls", 0, (24, 32), "raster", "balls") as shard:
        shard.add(replace(ball_heads.head(0), metadata=metadata))
    build_manifest(tmp_path / "balls", 1, {"train": ["id0000"]}, {}, provenance({}, {}))
    return tmp_path / "balls"
