"""The files of an alignment give back what was written, and refuse what contradicts itself."""

import json
from dataclasses import replace

import numpy as np
import pytest
from cameras_around import arc, rig
from faces import landmarks, of_pixels, views
from test_template import people

from preface.align.alignment_files import (
    AlignedEntry,
    AlignmentIndex,
    ExcludedEntry,
    alignment_file,
    read_index,
    read_template,
    write_index,
    write_template,
)
from preface.align.landmarks import NoFace
from preface.align.options import AlignmentOptions
from preface.align.person_file import Alignment, read_alignment, write_alignment
from preface.align.placement import place_subject
from preface.align.subject import align_subject
from preface.align.template import build_template
from preface.artifacts import SCHEMA_DIRECTORY, ArtifactError, provenance

OPTIONS = AlignmentOptions()
SHIFTS = [(1.25, -0.5), (0.0, 0.125), (-3.5, 2.0), (0.75, 0.0), (0.0, 0.0)]


def example(name):
    return json.loads((SCHEMA_DIRECTORY / f"{name}.example.json").read_text())


def a_template():
    template = build_template(people(5), "ibug68", 260, procrustes=True)
    return replace(template, provenance=provenance({}, {}), metadata={"note": 1})


def a_person(count=3):
    """A person to whom much has happened: no face in a view, the chin wrong in another, and a landmark unseen."""
    poses = arc(count + 1)
    found = views(landmarks(), poses, rng=np.random.default_rng(0))
    found["cam00"] = NoFace("no face found")
    pixels = found["cam01"].pixels.copy()
    pixels[8] += 60
    pixels[5] = np.nan
    found["cam01"] = of_pixels(pixels)
    subject = align_subject(found, rig(poses), OPTIONS)
    shifted = {name: replace(v, correction=np.array(SHIFTS)) for name, v in subject.views.items() if v.used}
    subject = replace(subject, views={**subject.views, **shifted})
    placement = place_subject(subject.keypoints, a_template(), OPTIONS)
    return Alignment("id0000", "take00", subject, placement, found, provenance({}, {}), {"note": 2})


def assert_same(ours, theirs, **tolerance):
    """Equal field by field, NaN where NaN."""
    for name, value in vars(ours).items():
        other = getattr(theirs, name)
        if isinstance(value, np.ndarray):
            np.testing.assert_allclose(other, value, err_msg=name, **tolerance)
            assert other.dtype.kind == value.dtype.kind
        elif name != "canonical_from_rig":
            assert other == value, name


def test_a_template_comes_back_bit_for_bit(tmp_path):
    template = a_template()
    again = read_template(write_template(tmp_path / "template.json", template))
    assert_same(template, again, rtol=0, atol=0)
    np.testing.assert_allclose(
        again.canonical_from_rig.matrix, template.canonical_from_rig.matrix, rtol=0, atol=1e-15
    )
    assert_same(template, read_template(tmp_path), rtol=0, atol=0)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda t: t["keypoints"].pop("chin"), "keypoints.chin: is missing"),
        (lambda t: t["keypoints"].update(chin=[0, -0.5, 0]), "keypoints: their mean is .* not the origin"),
        (
            lambda t: t["canonical_from_rig"].update(quaternion_wxyz=[1, 1, 0, 0]),
            "quaternion_wxyz: its length",
        ),
        (lambda t: t.update(scheme="dlib"), "scheme: "),
        (lambda t: t.update(units="mm"), "units: "),
    ],
)
def test_a_template_that_is_none_is_refused_by_field(tmp_path, change, said):
    content = example("template")
    change(content)
    path = tmp_path / "template.json"
    path.write_text(json.dumps(content))
    with pytest.raises(ArtifactError, match=said):
        read_template(path)


@pytest.mark.parametrize("count", [3, 5])
def test_a_person_comes_back(tmp_path, count):
    person = a_person(count)
    again = read_alignment(write_alignment(tmp_path / "id0000.json", person))
    assert (again.identity, again.take) == ("id0000", "take00")
    assert (again.provenance, again.metadata) == (person.provenance, person.metadata)
    assert_same(person.subject.keypoints, again.subject.keypoints, rtol=0, atol=0)
    assert_same(person.placement, again.placement, rtol=0, atol=0)
    ours, theirs = person.placement.canonical_from_rig, again.placement.canonical_from_rig
    np.testing.assert_allclose(theirs.matrix, ours.matrix, rtol=0, atol=1e-14)
    assert_same(person.subject.landmarks, again.subject.landmarks, rtol=1e-6, atol=1e-4)
    np.testing.assert_allclose(
        again.subject.landmarks.points, person.subject.landmarks.points, rtol=0, atol=1e-8
    )
    assert again.subject.cameras == person.subject.cameras
    assert list(again.subject.views) == list(person.subject.views)
    for camera, verdict in person.subject.views.items():
        assert_same(verdict, again.subject.views[camera], rtol=0, atol=0)
    assert again.found["cam00"] == person.found["cam00"]
    for camera in person.subject.cameras:
        assert_same(person.found[camera], again.found[camera], rtol=0, atol=1e-4)


def test_an_excluded_person_has_no_file(tmp_path):
    person = a_person()
    excluded = replace(person, subject=replace(person.subject, excluded="no two views agree"))
    with pytest.raises(ArtifactError, match="'id0000' is excluded: no two views agree"):
        write_alignment(tmp_path / "id0000.json", excluded)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda a: a["canonical_from_rig"].update(scale=-1), "canonical_from_rig.scale"),
        (lambda a: a["canonical_from_rig"].update(quaternion_wxyz=[2, 0, 0, 0]), "its length is 2"),
        (lambda a: a["landmarks"]["points"].pop(), "landmarks.points: has 67 entries.* 68 landmarks"),
        (lambda a: a["landmarks"]["inliers"][0].pop(), "landmarks.inliers: is not an array"),
        (lambda a: a["landmarks"]["reason"].__setitem__(0, 9), "landmarks.reason"),
        (lambda a: a["landmarks"]["points"].__setitem__(0, "x"), "landmarks.points"),
        (lambda a: a["cameras"].__setitem__(0, "rear"), r"cameras\[0\]: 'rear' is not a view that is used"),
        (lambda a: a["keypoints"].update(ear=[0, 0, 0]), "keypoints.ear: is not a known key"),
        (lambda a: a["views"]["left"].update(code="fine"), "views.left.code"),
        (lambda a: a["views"]["left"].pop("sigma"), "views.left.sigma: is missing"),
    ],
)
def test_a_person_that_contradicts_itself_is_refused_by_field(tmp_path, change, said):
    content = example("alignment")
    change(content)
    path = tmp_path / "id0000.json"
    path.write_text(json.dumps(content))
    with pytest.raises(ArtifactError, match=said):
        read_alignment(path)


def test_the_example_can_be_read():
    person = read_alignment(SCHEMA_DIRECTORY / "alignment.example.json")
    assert person.subject.keypoints.good.all()
    assert person.subject.landmarks.ok.all()


def an_alignment(folder):
    write_template(folder / "template.json", a_template())
    person = a_person()
    write_alignment(folder / alignment_file("id0000"), person)
    return AlignmentIndex(
        scheme="ibug68",
        aligned=(AlignedEntry.of("id0000", "take00", person.subject, person.placement),),
        excluded=(ExcludedEntry("id0001", "take00", "no two views agree"),),
        warnings=("Something.",),
        provenance=provenance({}, {}),
        metadata={"note": 3},
    )


def test_an_index_comes_back(tmp_path):
    index = an_alignment(tmp_path)
    write_index(tmp_path, index)
    assert read_index(tmp_path) == read_index(tmp_path / "alignment.json") == index
    assert index.aligned[0].keypoints == ("right_eye_outer", "left_eye_outer", "nose_tip", "mouth_center")


def test_an_index_is_not_written_before_its_files(tmp_path):
    index = an_alignment(tmp_path)
    (tmp_path / "id0000.json").unlink()
    with pytest.raises(ArtifactError, match=r"aligned\[0\].file: there is no id0000.json"):
        write_index(tmp_path, index)
    assert not (tmp_path / "alignment.json").exists()


def test_a_file_that_was_lost_is_noticed(tmp_path):
    write_index(tmp_path, an_alignment(tmp_path))
    (tmp_path / "id0000.json").unlink()
    with pytest.raises(ArtifactError, match=r"there is no id0000\.json\. Copy the whole folder"):
        read_index(tmp_path)


def test_a_person_appears_once(tmp_path):
    index = an_alignment(tmp_path)
    twice = replace(index, excluded=(ExcludedEntry("ID0000", "take00", "no face"),))
    with pytest.raises(ArtifactError, match="'ID0000' appears twice"):
        write_index(tmp_path, twice)


@pytest.mark.parametrize("name", ["template", "Alignment"])
def test_a_person_cannot_have_the_name_of_another_file(name):
    with pytest.raises(ArtifactError, match="is the name of another file"):
        alignment_file(name)


def test_everybody_may_be_excluded(tmp_path):
    write_template(tmp_path / "template.json", a_template())
    index = AlignmentIndex("ibug68", (), (ExcludedEntry("id0000", "take00", "no face"),))
    write_index(tmp_path, index)
    assert read_index(tmp_path) == index
