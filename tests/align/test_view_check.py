"""Views are judged as wholes: what a detector got wrong is left out, and named where it can be."""

import numpy as np
import pytest
from cameras_around import LENS, arc, looking_at_origin, stack
from faces import EYE_DISTANCE, flipped, landmarks, swapped, views

from preface.align.keypoints import IBUG68
from preface.align.options import TriangulationOptions
from preface.align.view_check import judge_views
from preface.align.view_consensus import measure

TOLERANCE, CREDIBLE = 0.03, 0.02
ELSEWHERE = np.array([0.3, 0.05, -0.3])  # where another person stands


def judged(found, poses):
    pixels = np.stack([view.pixels for view in found.values()])
    count = len(poses)
    deviations = np.full((count, 5), 0.01)
    measured = measure(
        IBUG68, stack(poses), [LENS.width] * count, pixels, np.zeros((count, 5, 2)), deviations
    )
    return judge_views(measured, TOLERANCE, CREDIBLE, TriangulationOptions())


def seen(poses, seed=0):
    return views(landmarks(), poses, rng=np.random.default_rng(seed))


def codes(judgement):
    return [verdict.code for verdict in judgement.verdicts]


@pytest.mark.parametrize("count", [3, 5, 13])
def test_good_views_agree(count):
    poses = arc(count)
    judgement = judged(seen(poses), poses)
    assert codes(judgement) == ["agrees"] * count
    assert judgement.kept.all()
    assert max(np.max(verdict.disagreement) for verdict in judgement.verdicts) < 0.02
    np.testing.assert_allclose(judgement.points, landmarks()[[36, 45, 30, 62, 8]], atol=0.002)


@pytest.mark.parametrize("wrong", [1, 2])
@pytest.mark.parametrize(("change", "code"), [(flipped, "mirrored"), (swapped, "swapped")])
def test_mirrored_views_are_named(wrong, change, code):
    poses = arc(6)
    found = seen(poses)
    for index in range(wrong):
        found[f"cam{index:02d}"] = change(found[f"cam{index:02d}"])
    judgement = judged(found, poses)
    assert codes(judgement) == [code] * wrong + ["agrees"] * (6 - wrong)
    assert all("right" in v.reason or "mirrored" in v.reason for v in judgement.verdicts[:wrong])


def test_one_mirrored_view_of_three_is_named():
    """Two views agree with anything; that the third would agree when mirrored tells which two are right."""
    poses = arc(3)
    found = seen(poses)
    found["cam00"] = flipped(found["cam00"])
    assert codes(judged(found, poses)) == ["mirrored", "unchecked", "unchecked"]


@pytest.mark.parametrize("kind", ["scattered", "other person"])
def test_half_of_the_views_may_be_wrong(kind):
    poses = arc(12)
    found, rng = seen(poses), np.random.default_rng(1)
    other = views(landmarks() + ELSEWHERE, poses, rng=rng)
    wrong = [0, 3, 4, 7, 10] if kind == "other person" else [0, 3, 4, 7, 9, 10]
    for index in wrong:
        name = f"cam{index:02d}"
        if kind == "other person":
            found[name] = other[name]
        else:
            found[name].pixels[:] += rng.normal(0, 80, (68, 2))
    judgement = judged(found, poses)
    assert [not verdict.used for verdict in judgement.verdicts] == [index in wrong for index in range(12)]
    assert {judgement.verdicts[index].code for index in wrong} == {"disagrees"}


def test_two_people_with_as_many_views_each_are_ambiguous():
    poses = arc(6)
    found, other = seen(poses), views(landmarks() + ELSEWHERE, poses)
    for index in (1, 3, 5):
        found[f"cam{index:02d}"] = other[f"cam{index:02d}"]
    judgement = judged(found, poses)
    assert codes(judgement) == ["ambiguous"] * 6
    assert not judgement.kept.any()


@pytest.mark.parametrize("share", [0.05, 0.2])
def test_one_wrong_keypoint_is_left_out_and_the_view_is_kept(share):
    poses = arc(8)
    found = seen(poses)
    chin = IBUG68.keypoints["chin"][0]
    per_share = EYE_DISTANCE * LENS.params[0]  # pixels, at a distance of 1 m
    found["cam02"].pixels[chin] += share * per_share * np.array([0.8, 0.6])
    judgement = judged(found, poses)
    assert codes(judgement) == ["agrees", "agrees", "partly"] + ["agrees"] * 5
    verdict = judgement.verdicts[2]
    assert verdict.left_out == ("chin",)
    assert verdict.disagreement[4] == pytest.approx(share, rel=0.15)
    assert "chin" in verdict.reason
    assert judgement.kept[2].tolist() == [True, True, True, True, False]


def test_nothing_that_is_kept_disagrees_by_more_than_the_tolerance():
    """Errors as detectors make them: each view off by some per cent, keypoint by keypoint."""
    poses, rng = arc(11), np.random.default_rng(2)
    found = seen(poses)
    for view in found.values():
        for members in IBUG68.keypoints.values():
            view.pixels[list(members)] += rng.normal(0, 0.015 * EYE_DISTANCE * LENS.params[0], 2)
    judgement = judged(found, poses)
    kept = np.array([verdict.disagreement for verdict in judgement.verdicts])[judgement.kept]
    assert judgement.kept.any(1).sum() >= 8
    assert kept.max() <= TOLERANCE


def test_a_keypoint_on_which_no_views_agree_is_in_none():
    poses, rng = arc(7), np.random.default_rng(3)
    found = seen(poses)
    for view in found.values():
        view.pixels[30] += rng.normal(0, 60, 2)
    judgement = judged(found, poses)
    assert not judgement.kept[:, 2].any()
    assert judgement.kept[:, [0, 1, 3, 4]].all()
    assert np.isnan(judgement.points[2]).all()


def test_two_views_are_used_but_not_checked():
    poses = arc(2, reach=20)
    judgement = judged(seen(poses), poses)
    assert codes(judgement) == ["unchecked", "unchecked"]
    assert all(verdict.used and "third" in verdict.reason for verdict in judgement.verdicts)


def test_two_views_that_contradict_each_other_are_both_left_out():
    poses = arc(2, reach=20)
    found = seen(poses)
    found["cam00"].pixels[:, 1] += 60
    judgement = judged(found, poses)
    assert codes(judgement) == ["disagrees", "disagrees"]
    assert "no two views agree" in judgement.verdicts[0].reason


def test_a_view_that_shows_two_keypoints_is_not_judged():
    poses = arc(4)
    found = seen(poses)
    found["cam01"].pixels[[36, 30, 8]] = np.nan
    assert codes(judged(found, poses)) == ["agrees", "unseen", "agrees", "agrees"]


def test_a_hidden_keypoint_is_no_disagreement():
    poses = arc(5)
    found = seen(poses)
    found["cam00"].pixels[45] = np.nan  # the far eye of a side view
    judgement = judged(found, poses)
    assert codes(judgement) == ["agrees"] * 5
    assert judgement.verdicts[0].left_out == ("left_eye_outer",)
    assert np.isnan(judgement.verdicts[0].disagreement[1])


def test_views_from_almost_one_direction_leave_the_depth_open():
    poses = [looking_at_origin(0), looking_at_origin(1.2)]
    judgement = judged(views(landmarks(), poses), poses)
    assert codes(judgement) == ["disagrees"] * 2
    assert not judgement.kept.any()
