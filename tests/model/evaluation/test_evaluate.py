"""A head evaluated against photographs that are known in closed form, with a renderer that is known as well."""

import ball_heads
import numpy as np
import pytest
import torch
import untrained

from preface.artifacts import ArtifactError
from preface.model.evaluation import evaluate
from preface.model.evaluation.evaluate import evaluate_head, photograph_on_black
from preface.model.evaluation.options import EvaluationOptions
from preface.model.model import Level, Render
from preface.model.training.prior_files import read_prior

OPTIONS = EvaluationOptions(lpips="none")


def analytic_ball(number: int, offset=(0.0, 0.0, 0.0), scale=1 / 0.15):
    """Renders the ball of `ball_heads` of a number by ray casting in float64, moved by an offset in metres."""
    radius = 0.1 + 0.008 * (number % 4)

    def render(rays) -> Render:
        origins = rays.origins.double().numpy() / scale - np.array(offset)
        viewdirs = rays.viewdirs.double().numpy()
        along = (origins * viewdirs).sum(-1)
        inside = along**2 - (origins**2).sum(-1) + radius**2
        hit = inside > 0
        far = -along - np.sqrt(np.maximum(inside, 0))
        normal = (origins + far[:, None] * viewdirs) / radius
        rgb = np.where(hit[:, None], ball_heads.paint(normal, number), 0.0)
        distance = far * scale / np.linalg.norm(rays.directions.double().numpy(), axis=-1)
        rgb, acc, distance, normal = (torch.from_numpy(x).float() for x in (rgb, hit, distance, normal))
        one = torch.ones(len(rays), 1)
        level = Level(one, one, one, one)
        return Render((level,), rgb, acc, distance, distance, normals=normal[:, None])

    return render


@pytest.fixture
def rendered_as(monkeypatch):
    """Puts a renderer in the place of a model's."""
    return lambda render: monkeypatch.setattr(evaluate, "head_renderer", lambda *_, **__: render)


def test_a_perfect_model_is_found_perfect_at_every_view(prior, dataset, rendered_as):
    """Cameras, poses, pixels, masks and depths all have to be right for it."""
    rendered_as(analytic_ball(1))
    known = read_prior(prior)
    found = evaluate_head(known, dataset, "id0001", [f"camera{n}" for n in range(6)], OPTIONS)
    for view in found.views:
        # What remains is the rounding to bytes: at most 1/510 in any pixel.
        assert np.abs(view.rgb - view.truth).max() < 1 / 509
        assert view.figures.values["psnr"] > 54
        assert view.figures.values["silhouette_iou"] == 1
        assert view.figures.values["ssim_face"] > 0.999
        center = view.figures.canonical_from_camera.translation
        nearest = np.nanmin(view.depth)
        assert nearest == pytest.approx(np.linalg.norm(center) - 0.108, abs=2e-3)
    assert found.mean["psnr"] == pytest.approx(np.mean([v.figures.values["psnr"] for v in found.views]))


def test_a_model_that_is_moved_by_a_pixel_or_two_is_worse_the_further(prior, dataset, rendered_as):
    known, found = read_prior(prior), []
    for offset in (0.0, 0.011, 0.022):  # a pixel covers 11 mm
        rendered_as(analytic_ball(2, (0.0, offset, 0.0)))
        found.append(evaluate_head(known, dataset, "id0002", None, OPTIONS).mean)
    assert found[0]["psnr"] > 54
    for figure, by in (("psnr", 3), ("psnr_face", 3), ("ssim", 0.02), ("silhouette_iou", 0.02)):
        assert found[0][figure] > found[1][figure] + by > found[2][figure] + 1.3 * by, figure


def test_figures_are_those_of_the_images_that_are_returned_in_plain_float64(prior, dataset):
    known = read_prior(prior)
    found = evaluate_head(known, dataset, "id0001", ["camera0", "camera3"], OPTIONS)
    for view in found.views:
        square, values = view.figures.face, view.figures.values
        rgb, truth = view.rgb.astype(np.float64), view.truth.astype(np.float64)
        assert values["psnr"] == pytest.approx(-10 * np.log10(((rgb - truth) ** 2).mean()), abs=1e-9)
        rows = slice(square.top, square.top + square.side)
        columns = slice(square.left, square.left + square.side)
        error = ((rgb - truth)[rows, columns] ** 2).mean()
        assert values["psnr_face"] == pytest.approx(-10 * np.log10(error), abs=1e-9)
        body = view.mask > 0.5
        foreground = ((rgb - truth)[body] ** 2).mean()
        assert values["psnr_foreground"] == pytest.approx(-10 * np.log10(foreground), abs=1e-9)
        assert rgb.min() >= 0
        assert rgb.max() <= 1


def test_the_truth_is_the_photograph_on_black(dataset):
    truth, mask = photograph_on_black(dataset, "id0001", "camera2")
    pixels = dataset.pixels(1, 2)
    assert (pixels[..., :3][pixels[..., 3] == 0] == 90).all()  # grey on the disk
    assert (truth[mask == 0] == 0).all()
    np.testing.assert_allclose(truth[mask == 1] * 255, pixels[..., :3][mask == 1], atol=1e-4)


def test_what_floats_beside_the_head_counts_against_it(prior, dataset, rendered_as):
    ball = analytic_ball(1)

    def with_floater(rays) -> Render:
        seen = ball(rays)
        seen.rgb[seen.acc == 0] = 0.2
        return seen

    rendered_as(ball)
    clean = evaluate_head(read_prior(prior), dataset, "id0001", None, OPTIONS).mean
    rendered_as(with_floater)
    dirty = evaluate_head(read_prior(prior), dataset, "id0001", None, OPTIONS).mean
    assert dirty["psnr"] < clean["psnr"] - 20
    assert dirty["psnr_foreground"] == clean["psnr_foreground"]


@pytest.mark.parametrize("quality", ["reference", "balanced"])
def test_a_prior_with_a_background_of_its_own_is_evaluated_within_the_box(tmp_path, dataset, quality):
    """As the paper renders it: nothing is shown outside the box, and what is within is masked as the photograph is."""
    options, names = EvaluationOptions(lpips="none", quality=quality), ["id0001"]
    open_ = {"clip_to_box": False, "background": "modelled"}
    folders = [
        untrained.write_model(tmp_path / name, names, {"id0001": ("camera2",)}, **model)
        for name, model in (("clipped", {}), ("open", open_))
    ]
    clipped, found = (
        evaluate_head(read_prior(folder), dataset, "id0001", None, options) for folder in folders
    )
    view = clipped.views[0]
    np.testing.assert_array_equal(found.views[0].rgb, view.rgb * view.mask[..., None])
    assert view.rgb[view.mask == 0].max() > 0
    assert found.mean["silhouette_iou"] == clipped.mean["silhouette_iou"]


def test_the_angle_to_the_nearest_photograph_that_was_seen(head, dataset):
    names = ["camera0", "camera2"]
    found = evaluate_head(read_prior(head("a", names)), dataset, "id0000", ["camera1", "camera2"], OPTIONS)
    centers = [pose.translation / np.linalg.norm(pose.translation) for pose in ball_heads.poses()]
    expected = min(np.degrees(np.arccos(centers[1] @ centers[n])) for n in (0, 2))
    assert found.views[0].figures.degrees_from_fitted == pytest.approx(expected)
    assert not found.views[0].figures.fitted
    assert found.views[1].figures.fitted
    assert found.views[1].figures.degrees_from_fitted == 0


def test_without_normals_no_density_is_differentiated_and_the_figures_are_the_same(
    prior, dataset, monkeypatch
):
    known, plain = read_prior(prior), EvaluationOptions(lpips="none", normals=False)
    shown = evaluate_head(known, dataset, "id0001", None, OPTIONS)
    assert all(view.normals.shape == view.rgb.shape for view in shown.views)

    def refused(*_, **__):
        raise AssertionError("a derivative was taken")

    monkeypatch.setattr(torch.autograd, "grad", refused)
    with pytest.raises(AssertionError, match="derivative"):
        evaluate_head(known, dataset, "id0001", None, OPTIONS)
    found = evaluate_head(known, dataset, "id0001", None, plain)
    assert found.mean == shown.mean
    assert all(view.normals is None for view in found.views)
    for one, other in zip(found.views, shown.views, strict=True):
        np.testing.assert_array_equal(one.rgb, other.rgb)
        np.testing.assert_array_equal(one.depth, other.depth)


def test_missing_weights_of_lpips_name_the_command_that_gets_them(prior, dataset, monkeypatch, tmp_path):
    monkeypatch.setenv("PREFACE_CACHE", str(tmp_path))
    with pytest.raises(ArtifactError, match=r"python -m preface\.model\.metrics\.lpips_weights"):
        evaluate_head(read_prior(prior), dataset, "id0001", None, EvaluationOptions(lpips="vgg"))
