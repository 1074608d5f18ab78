"""Evaluations at the limits, of heads whose every pixel is known: nothing at all, or a box full of one colour.

A box full of an opaque colour shows that colour wherever a ray meets it, and black elsewhere; against photographs that
are all of one colour every figure is then a number of a formula.
"""

import math
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

sys.path.insert(0, str(Path(__file__).resolve().parent))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "model" / "evaluation"))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "model" / "training"))

import ball_heads
import untrained
from ball_views import FOCAL, UNSEEN, all_of_one_color, everywhere, names, place, shards_of

from preface.artifacts import ArtifactError
from preface.model.evaluation.evaluate import Evaluation, evaluate_head
from preface.model.evaluation.options import EvaluationOptions
from preface.model.rendering.paths import look_at
from preface.model.training.checkpoint import WEIGHTS, write_checkpoint
from preface.model.training.prior_files import prior_payload, read_prior
from preface.shards import Dataset

CLOSE = 6 * FOCAL  # so near that the box fills the image
PLAIN = EvaluationOptions(lpips="none")


@pytest.fixture(autouse=True)
def _one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def head_full_of(folder: Path, raw_density: float, raw_color: float) -> Path:
    """A head whose networks say the same everywhere: nothing at all, or a wall at the box."""
    untrained.write_model(folder, [UNSEEN], fit=untrained.fitted_to(["elsewhere"], UNSEEN), samples=(8,))
    described = read_prior(folder)
    weights = described.load_model().state_dict()
    for network in ("proposal", "nerf"):
        weights[f"{network}.density.weight"].zero_()
        weights[f"{network}.density.code_weight"].zero_()
        weights[f"{network}.density.bias"].fill_(raw_density)
    weights["nerf.color.weight"].zero_()
    weights["nerf.color.bias"].fill_(raw_color)
    write_checkpoint(folder, prior_payload(described), {WEIGHTS: weights})
    return folder


@pytest.fixture(scope="module")
def heads(tmp_path_factory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("heads")
    return {
        "nothing": head_full_of(folder / "nothing", -1e30, 0.0),
        "white": head_full_of(folder / "white", 1e6, 1e6),
        "grey": head_full_of(folder / "grey", 1e6, 0.0),
    }


def photographs(value: int, alpha: int):
    def change(pixels):
        all_of_one_color(value)(pixels)
        everywhere(alpha)(pixels)

    return change


def evaluated(head: Path, shards: Path, options: EvaluationOptions = PLAIN, views=None) -> Evaluation:
    with Dataset(shards) as dataset:
        return evaluate_head(read_prior(head), dataset, UNSEEN, views, options)


@pytest.mark.parametrize(
    ("head", "value", "alpha", "mse"),
    [
        ("white", 255, 255, 0.0),
        ("white", 0, 255, 1.0),
        ("white", 255, 0, 1.0),  # a photograph without foreground is black
        ("nothing", 255, 255, 1.0),
        ("nothing", 255, 0, 0.0),
        ("nothing", 0, 255, 0.0),
        ("grey", 255, 255, 0.25),
        ("grey", 0, 255, 0.25),
        ("white", 255, 51, 0.64),  # a fifth of foreground everywhere is grey
    ],
)
def test_one_color_against_another_has_the_figures_of_the_formulas(head, value, alpha, mse, heads, tmp_path):
    shards = shards_of(tmp_path / "shards", [place(0.0)], focal=CLOSE, change=photographs(value, alpha))
    (view,) = evaluated(heads[head], shards).views
    figures = view.figures.values
    expected = 100.0 if mse == 0 else -10 * math.log10(mse)
    assert figures["psnr"] == pytest.approx(expected, abs=1e-5)
    assert figures["psnr_face"] == pytest.approx(expected, abs=1e-5)
    a, b = {"white": 1.0, "nothing": 0.0, "grey": 0.5}[head], value / 255 * alpha / 255
    ssim = (2 * a * b + 1e-4) / (a * a + b * b + 1e-4)
    assert figures["ssim"] == pytest.approx(ssim, abs=1e-5)
    if alpha > 127:
        assert figures["silhouette_iou"] == (0 if head == "nothing" else 1)
        assert figures["psnr_foreground"] == pytest.approx(expected, abs=1e-5)
    else:
        assert set(view.figures.left_out) >= {"silhouette_iou", "psnr_foreground"}
        assert "silhouette_iou" not in figures


@pytest.mark.parametrize(
    ("size", "there", "left_out"),
    [
        ((16, 16), {"psnr", "ssim", "lpips"}, set()),
        ((15, 16), {"psnr", "ssim"}, {"lpips"}),
        ((10, 40), {"psnr"}, {"ssim", "lpips"}),
        ((1, 1), {"psnr"}, {"ssim", "lpips"}),
        ((4096, 2), {"psnr"}, {"ssim", "lpips"}),
    ],
)
def test_small_and_long_views_have_the_figures_that_they_are_large_enough_for(
    size, there, left_out, heads, tmp_path
):
    focal = CLOSE if max(size) < 50 else 4096 / 24 * CLOSE
    shards = shards_of(tmp_path / "shards", [place(0.0)], size, focal, photographs(0, 255))
    (view,) = evaluated(heads["grey"], shards, EvaluationOptions(lpips="vgg")).views
    assert there <= set(view.figures.values)
    assert left_out <= set(view.figures.left_out)
    assert not left_out & set(view.figures.values)
    assert view.figures.values["psnr"] == pytest.approx(-10 * math.log10(0.25), abs=1e-5)
    assert view.rgb.shape == (size[1], size[0], 3)


@pytest.mark.parametrize(
    ("pose", "focal", "face"),
    [
        (place(0.0, 0.0, 0.05), 8.0, True),
        (place(170.0), FOCAL, True),
        (place(0.0, 0.0, 100.0), 100 * FOCAL, True),
        (look_at(np.array([0.0, 0.0, 0.1]), np.array([0.0, 0.01, 1.0])), 20.0, False),
        (look_at(np.array([0.0, 0.0, 1.0]), np.array([0.3, 0.0, 2.0])), FOCAL, False),
    ],
    ids=["inside the box", "behind the head", "100 m away", "inside, looking out", "looking away"],
)
def test_cameras_anywhere_see_the_box_where_it_is(pose, focal, face, heads, tmp_path):
    shards = shards_of(tmp_path / "shards", [pose], focal=focal, change=photographs(255, 255))
    (view,) = evaluated(heads["white"], shards).views
    # Half a pixel less than the whole image, ray by ray against the box in float64.
    x, y = np.meshgrid(np.arange(24) + 0.5 - 12, np.arange(32) + 0.5 - 16)
    rays = np.stack([x / focal, y / focal, np.ones_like(x)], axis=-1) @ pose.rotation.T
    with np.errstate(divide="ignore"):
        ends = (ball_heads.BOX[:, None, None] - pose.translation) / rays
    near, far = ends.min(axis=0).max(axis=-1).clip(0), ends.max(axis=0).min(axis=-1)
    met = near < far
    np.testing.assert_array_equal(view.alpha > 0.5, met)
    mse = 1 - met.mean()
    expected = 100.0 if mse == 0 else -10 * math.log10(mse)
    assert view.figures.values["psnr"] == pytest.approx(expected, abs=1e-4)
    assert (view.figures.face is not None) == face
    assert ("psnr_face" in view.figures.values) == face
    assert np.isfinite(list(view.figures.values.values())).all()


@pytest.mark.parametrize("rays_at_a_time", [1, 23, 10**6])
def test_figures_do_not_depend_on_how_many_rays_are_rendered_together(rays_at_a_time, heads, tmp_path):
    shards = shards_of(tmp_path / "shards", [place(30.0)], (12, 11), 40.0)
    figures = [
        evaluated(heads["grey"], shards, EvaluationOptions(lpips="none", rays_at_a_time=n)).mean
        for n in (rays_at_a_time, 50)
    ]
    assert figures[0] == pytest.approx(figures[1], abs=1e-6)


def test_a_mean_is_over_the_views_that_have_the_figure(heads, tmp_path):
    away = look_at(np.array([0.0, 0.0, 1.0]), np.array([0.3, 0.0, 2.0]))
    shards = shards_of(tmp_path / "shards", [place(0.0), away], focal=CLOSE, change=photographs(0, 255))
    found = evaluated(heads["grey"], shards)
    assert [view.figures.name for view in found.views] == list(names(2))
    assert found.mean["psnr"] == pytest.approx((-10 * math.log10(0.25) + 100) / 2, abs=1e-5)
    assert found.mean["psnr_face"] == pytest.approx(-10 * math.log10(0.25), abs=1e-5)


def test_a_head_with_a_weight_that_is_not_a_number_is_refused_by_the_name_of_the_weight(tmp_path):
    head = head_full_of(tmp_path / "head", math.nan, 0.0)
    shards = shards_of(tmp_path / "shards", [place(0.0)])
    with pytest.raises(ArtifactError, match=r"density\.bias: has values that are not finite"):
        evaluated(head, shards)
