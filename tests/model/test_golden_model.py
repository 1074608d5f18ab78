"""A whole model with multinerf's parameters against multinerf's outputs, and the loader's refusals."""

import numpy as np
import pytest
import torch

from preface.model import losses
from preface.model.plain import PlainModel, PlainRays, PlainRender, load_multinerf


@pytest.fixture(scope="module")
def model(golden_arrays) -> PlainModel:
    return load_multinerf(golden_arrays)


@pytest.fixture(scope="module")
def rays(golden) -> PlainRays:
    origins, directions, radii = (golden(f"cast_{name}") for name in ("origins", "directions", "radii"))
    viewdirs = directions / directions.norm(dim=-1, keepdim=True)
    return PlainRays(
        origins, directions, viewdirs, radii, torch.full_like(radii, 2.0), torch.full_like(radii, 4.0)
    )


@pytest.fixture(scope="module", params=["1.0", "0.3"])
def rendered(request, model, rays) -> tuple[str, PlainRender]:
    return f"model_out_{request.param}/", model(rays, float(request.param))


def off(ours: torch.Tensor, theirs: torch.Tensor) -> float:
    assert ours.shape == theirs.shape
    return float((ours - theirs).detach().abs().max())


@pytest.mark.parametrize("level", [0, 1, 2])
def test_golden_levels(rendered, golden, level: int) -> None:
    prefix, ours = rendered
    for name, tolerance in (("sdist", 1e-4), ("weights", 1e-5), ("density", 1e-4)):
        assert off(getattr(ours.levels[level], name), golden(f"{prefix}level{level}_{name}")) < tolerance, (
            name
        )


@pytest.mark.parametrize(
    ("name", "tolerance"),
    [("rgb", 1e-4), ("acc", 1e-5), ("distance_mean", 2e-5), ("distance_median", 1e-4)],
)
def test_golden_rendering(rendered, golden, name: str, tolerance: float) -> None:
    prefix, ours = rendered
    assert off(getattr(ours, name), golden(prefix + name)) < tolerance


def test_golden_normals(rendered, golden) -> None:
    """A gradient passes through 2^11: what the encoding's last levels lose, it shows."""
    prefix, ours = rendered
    assert off(ours.normals, golden(f"{prefix}normals")) < 1e-2
    assert off(ours.normals_pred, golden(f"{prefix}normals_pred")) < 1e-3
    loss = losses.predicted_normal_per_ray(ours.levels[-1].weights, ours.normals, ours.normals_pred)
    assert off(loss, golden(f"{prefix}pred_normal_loss_per_ray")) < 1e-4


def test_golden_model_in_float64_confirms_the_figures(golden_arrays, golden, rays) -> None:
    double = load_multinerf(golden_arrays).double()
    out = double(PlainRays(**{name: value.double() for name, value in vars(rays).items()}))
    assert off(out.rgb, golden("model_out_1.0/rgb").double()) < 1e-5
    assert off(out.levels[-1].sdist, golden("model_out_1.0/level2_sdist").double()) < 1e-5


def test_golden_parameters_are_all_used(model, golden_arrays) -> None:
    stored = sum(value.size for key, value in golden_arrays.items() if key.startswith("model_param/"))
    assert sum(p.numel() for p in model.parameters()) == stored


def test_predicted_normal_loss_of_the_model_reaches_its_density(model, rays) -> None:
    out = model(rays)
    model.zero_grad()
    losses.predicted_normal(
        out.levels[-1].weights.detach(), out.normals, out.normals_pred.detach()
    ).backward()
    gradients = [p.grad for p in model.nerf.parameters() if p.grad is not None]
    assert sum(float(g.abs().sum()) for g in gradients) > 1e-3
    assert all(g.isfinite().all() for g in gradients)
    assert all(p.grad is None or not p.grad.any() for p in model.color.parameters())


def test_loader_says_which_array_does_not_fit(golden_arrays) -> None:
    wrong = dict(golden_arrays)
    wrong["model_param/NerfMLP_0/Dense_3/kernel"] = np.zeros((64, 65), np.float32)
    with pytest.raises(ValueError, match=r"\(64, 65\)"):
        load_multinerf(wrong)


def test_loader_refuses_arrays_of_something_else() -> None:
    with pytest.raises(ValueError, match="0 layers of NerfMLP_0"):
        load_multinerf({"weights": np.zeros(3)})


def test_loader_names_a_missing_array(golden_arrays) -> None:
    missing = {k: v for k, v in golden_arrays.items() if k != "model_param/PropMLP_0/Dense_2/bias"}
    with pytest.raises(KeyError, match="PropMLP_0/Dense_2/bias"):
        load_multinerf(missing)
