"""The report of an alignment says what was used, what was not and why, and sums up the right figures."""

from dataclasses import replace

import made_up_studio as made
import numpy as np
import pytest

from preface.align.landmark_sheet import GREEN, RED, landmark_sheet, worst_first
from preface.align.report import alignment_report
from preface.artifacts import load_json


def photograph(person, camera):
    return np.full((made.SIZE[1], made.SIZE[0], 3), 40, np.uint8)


def twin(studio, tmp_path, load_image=photograph):
    return load_json(alignment_report(studio, {}, load_image).write(tmp_path / "r.html").with_suffix(".json"))


def blocks(content, kind):
    return [block for section in content["sections"] for block in section["blocks"] if block["kind"] == kind]


def figure(content, name):
    return next(f["value"] for b in blocks(content, "key_figures") for f in b["figures"] if f["name"] == name)


def rows(content, *columns):
    """The rows of the first table that has all these columns."""
    tables = blocks(content, "table")
    return next(t["rows"] for t in tables if set(columns) <= {column["name"] for column in t["columns"]})


@pytest.fixture(scope="module")
def eventful(tmp_path_factory):
    """The twin of a studio in which much happened, to be read only."""
    studio = made.made_up(((0, 0, 0), (0.003, 0, 0), (-0.003, 0, 0), (5.0, 0, 0)))
    studio = made.without_face(studio, "p1", "left")
    studio = made.with_verdict(studio, "p2", "right", made.verdict("mirrored", "left is right", 0.5))
    studio = made.with_verdict(studio, "p0", "middle", made.verdict("agrees", "", 0.025))
    studio = made.excluding(studio, "p3", "only 1 view shows the face")
    keypoints = studio.subjects["p1"].keypoints
    keypoints.positions[4] = np.nan
    keypoints.covariance[4] = np.nan
    return twin(studio, tmp_path_factory.mktemp("report"))


def test_spread_is_that_of_where_people_stand_before_and_nothing_after():
    studio = made.made_up()
    assert studio.spread_before == pytest.approx(np.full(5, np.sqrt((0 + 0.003**2 + 0.003**2) / 3)))
    assert studio.spread_after == pytest.approx(np.zeros(5), abs=1e-12)


def test_figures_of_the_summary(eventful):
    assert figure(eventful, "People aligned") == "3 of 4"
    assert figure(eventful, "Views used per person, mean") == pytest.approx((3 + 2 + 2) / 3)
    assert figure(eventful, "Reprojection of landmarks, median") == pytest.approx(0.5)
    assert figure(eventful, "Outer eye corners apart, median") == pytest.approx(90)


def test_views_that_are_left_out_do_not_count_as_accepted(eventful):
    assert figure(eventful, "Worst keypoint used of a view") == pytest.approx(2.5)


def test_keypoints_that_a_used_view_does_not_contribute_are_counted_and_do_not_count_as_accepted():
    partly = replace(made.verdict("partly"), used=True, disagreement=np.array([0.01, 0.02, 0.01, 0.01, 0.2]))
    studio = made.with_verdict(made.made_up(), "p0", "left", replace(partly, left_out=("chin",)))
    assert studio.disagreement("p0", "left") == pytest.approx(20)
    assert studio.accepted_disagreement("p0", "left") == pytest.approx(2)
    assert studio.keypoints_left_out("p0", "left") == ("chin",)


def test_a_keypoint_that_is_used_though_it_is_far_off_is_explained(tmp_path, eventful):
    assert "measured against what remains" not in str(blocks(eventful, "text"))
    studio = made.with_verdict(made.made_up(), "p0", "middle", made.verdict("agrees", "", 0.0343))
    content = twin(studio, tmp_path)
    assert figure(content, "Worst keypoint used of a view") == pytest.approx(3.43)
    assert "which is why one that is used may be further off" in str(blocks(content, "text"))


def test_every_view_left_out_is_listed_with_its_reason(eventful):
    listed = {
        (row["person"], row["camera"]): row["reason"] for row in rows(eventful, "person", "camera", "reason")
    }
    assert listed == {
        ("p1", "left"): "no face found at any scale or rotation",
        ("p2", "right"): "left is right",
    }
    counted = {(row["camera"], row["why"]): row["views"] for row in rows(eventful, "why", "views")}
    assert counted == {("left", "no face"): 1, ("right", "mirrored"): 1}


def test_people_left_out_are_listed_with_their_reason_and_do_not_enter_the_spread(eventful):
    assert rows(eventful, "person", "reason") == [{"person": "p3", "reason": "only 1 view shows the face"}]
    assert figure(eventful, "Spread of keypoints before, RMS") < 10


def test_a_missing_keypoint_is_missing_in_the_figures_of_its_person_only(eventful):
    people = {row["person"]: row for row in rows(eventful, "person", "keypoints")}
    assert [people[person]["keypoints"] for person in ("p0", "p1", "p2")] == [5, 4, 5]
    chin = next(row for row in rows(eventful, "before", "after") if row["keypoint"] == "chin")
    assert chin["before"] == pytest.approx(1.5)  # the two others stand 3 mm apart
    assert chin["after"] == pytest.approx(0, abs=1e-9)


def test_a_studio_without_anybody_aligned_or_any_photograph_still_has_a_report(tmp_path):
    studio = made.made_up()
    for person in list(studio.placements):
        studio = made.excluding(studio, person, "no view shows a face")
    content = twin(studio, tmp_path, lambda person, camera: None)
    assert figure(content, "People aligned") == "0 of 3"
    assert len(rows(content, "person", "reason")) == 3


def test_an_improbable_distance_of_the_eyes_speaks_of_the_unit_and_a_given_template_is_told(
    tmp_path, eventful
):
    assert "the metre" not in str(blocks(eventful, "text"))
    assert "given template" not in str(blocks(eventful, "text"))
    studio = replace(made.made_up(), joined=True)
    for person in studio.subjects.values():
        person.keypoints.positions[:] *= 1000
    words = str(blocks(twin(studio, tmp_path), "text"))
    assert "90000.0 mm" in words
    assert "not the metre" in words
    assert "given template" in words


def test_views_come_worst_first():
    studio = made.with_verdict(made.made_up(), "p1", "middle", made.verdict("disagrees", "is off", 0.2))
    studio = made.with_verdict(studio, "p2", "left", made.verdict("agrees", "", 0.025))
    studio = made.with_verdict(studio, "p0", "right", made.verdict("unchecked", "", np.nan))
    studio = made.without_face(studio, "p0", "left")
    order = worst_first(studio)
    assert order[:2] == [("p1", "middle"), ("p2", "left")]
    assert order[-1] == ("p0", "right")
    assert ("p0", "left") not in order


def test_the_sheet_draws_used_landmarks_green_and_others_red():
    studio = made.made_up()

    def share(sheet, color):
        return (np.abs(sheet.astype(int) - color).max(axis=-1) < 30).mean()

    good = landmark_sheet(studio, [("p0", "left")], photograph)
    assert share(good, GREEN) > 0.001
    assert share(good, RED) == 0
    studio.subjects["p0"].landmarks.inliers[:, 0] = False
    bad = landmark_sheet(studio, [("p0", "left")], photograph)
    assert share(bad, RED) > 0.001
    assert share(bad, GREEN) == 0
