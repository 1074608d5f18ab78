"""``tools/real_faces.py``: which pictures are fitted to, how cameras are brought onto others, and what is refused."""

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))

import real_faces
from preface.geometry import Similarity


def test_a_face_in_another_frame_and_scale_is_brought_onto_the_shipped_one():
    shipped = np.random.default_rng(0).normal(scale=0.05, size=(5, 3))
    motion = Similarity(0.03, Rotation.from_rotvec([0.2, -1.0, 0.5]).as_matrix(), [1.0, -2.0, 3.0])
    found = motion.apply(shipped)
    shipped[1], found[4] = np.nan, np.nan
    between = real_faces._between(shipped, found)
    assert float(between.scale) == pytest.approx(0.03, rel=1e-9)
    np.testing.assert_allclose(between.rotation, motion.rotation, atol=1e-9)
    np.testing.assert_allclose(between.translation, motion.translation, atol=1e-9)


def test_pictures_are_spread_from_one_side_to_the_other():
    names = list("abcdefghi")
    assert real_faces._spread(names, 3) == ["a", "e", "i"]
    most = real_faces._spread(names, 7)
    assert all(set(real_faces._spread(most, count)) <= set(most) for count in (2, 3, 5, 7))


def test_what_is_not_there_is_named_and_ends_with_one(tmp_path, capsys):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "rig.json").write_text("{}")
    words = [str(tmp_path / "nobody"), "--output", str(tmp_path / "out")]
    assert real_faces.main(["walk-around", *words]) == 1
    assert str(tmp_path / "nobody" / "images") in capsys.readouterr().err
    (tmp_path / "file").write_text("mine")
    assert real_faces.main(["walk-around", *words[:2], str(tmp_path / "file" / "out")]) == 1
    assert f"{tmp_path / 'file' / 'out'}: writing: " in capsys.readouterr().err
