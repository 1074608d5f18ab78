"""The pure functions against multinerf's figures, at the tolerances that come with them."""

import pytest
import torch

from preface.model import coord, losses, stepfun, volume


def off(ours: torch.Tensor, theirs: torch.Tensor) -> float:
    assert ours.shape == theirs.shape
    return float((ours - theirs).detach().abs().max())


def test_golden_basis(golden) -> None:
    assert off(coord.icosahedron_basis(torch.float64).T, golden("basis")) < 1e-15


def test_golden_frustum_gaussians(golden) -> None:
    tdist, directions = golden("cast_tdist"), golden("cast_directions")
    mean, cov = coord.conical_frustum_to_gaussian(
        directions, tdist[:, :-1], tdist[:, 1:], golden("cast_radii")
    )
    assert off(mean + golden("cast_origins")[:, None], golden("cast_mean")) < 5e-7
    assert off(cov, golden("cast_cov")) < 1e-8


def test_golden_projection_on_the_basis(golden) -> None:
    basis = golden("basis").T
    mean, var = coord.lift_and_diagonalize(golden("cast_mean"), golden("cast_cov"), basis)
    assert off(mean, golden("lift_mean")) < 5e-7
    assert off(var, golden("lift_var")) < 1e-8


def test_golden_projection_without_covariances(golden) -> None:
    """Both routes round; the truth lies between them, and ours is the nearer."""
    rays = [golden(f"cast_{name}") for name in ("origins", "directions", "tdist", "radii")]
    basis = coord.icosahedron_basis(torch.float64)
    truth = coord.project_frustums(*(x.double() for x in rays), basis)
    ours = coord.project_frustums(*rays, basis)
    theirs = golden("lift_mean"), golden("lift_var")
    scales = torch.ones(1, dtype=torch.float64), truth[1]  # the variance's digits count, not its size
    for got, want, exact, scale, tolerance in zip(ours, theirs, truth, scales, (2e-6, 1e-8), strict=True):
        assert off(got, want) < tolerance
        assert ((got - exact) / scale).square().mean() < ((want - exact) / scale).square().mean()


@pytest.mark.parametrize(("levels", "tolerance"), [(4, 1e-6), (10, 5e-5), (12, 4e-4)])
def test_golden_integrated_encoding(golden, levels: int, tolerance: float) -> None:
    ours = coord.integrated_pos_enc(golden("lift_mean"), golden("lift_var"), 0, levels)
    theirs = golden("ipe_12").unflatten(-1, (2, 12, 21))[:, :, :, :levels]
    assert off(ours, theirs.flatten(-3)) < tolerance


def test_golden_integrated_encoding_from_rays(golden) -> None:
    """multinerf's figures carry the rounding of its means, times 2048; ours is held to the truth as well."""
    rays = [golden(f"cast_{name}") for name in ("origins", "directions", "tdist", "radii")]
    basis = coord.icosahedron_basis(torch.float64)
    ours = coord.integrated_pos_enc(*coord.project_frustums(*rays, basis), 0, 12)
    truth = coord.integrated_pos_enc(*coord.project_frustums(*(x.double() for x in rays), basis), 0, 12)
    assert off(ours, golden("ipe_12")) < 8e-4
    assert off(ours, truth) < 4e-4


def test_golden_direction_encoding(golden) -> None:
    assert off(coord.pos_enc(golden("cast_directions"), 0, 4), golden("pos_enc_4")) < 1e-6


def test_golden_alpha_weights(golden) -> None:
    weights, _, trans = volume.compute_alpha_weights(
        golden("alpha_density"), golden("cast_tdist"), golden("cast_directions")
    )
    assert off(weights, golden("alpha_weights")) < 1e-7
    assert off(trans, golden("alpha_trans")) < 1e-7


@pytest.mark.parametrize(("anneal", "tolerance"), [(1.0, 2e-6), (0.3, 2e-5)])
def test_golden_resampling(golden, anneal: float, tolerance: float) -> None:
    """multinerf spaces its shares by (1 - eps) / n and rounds them: two eps of share are granted as well.

    Where the histogram is low that is a way; the two places say how far.
    """
    sdist, weights = golden("step_sdist"), golden("alpha_weights")

    def sampled(t: torch.Tensor, place_in_share: float) -> torch.Tensor:
        logits = stepfun.resampling_logits(t, weights.to(t), anneal)
        jitter = torch.full_like(t[:, :1], place_in_share)
        return stepfun.sample_intervals(t, logits, 24, jitter, domain=(0.0, 1.0))

    two_eps = 24 * 2 * 2.0**-23
    granted = (sampled(sdist.double(), 0.5 + two_eps) - sampled(sdist.double(), 0.5 - two_eps)).abs()
    theirs = golden(f"sample_intervals_anneal_{anneal}")
    assert (((sampled(sdist, 0.5) - theirs).abs() - granted) < tolerance).all()


def test_golden_dilation(golden) -> None:
    edges, weights = stepfun.max_dilate_weights(
        golden("step_sdist"),
        golden("alpha_weights"),
        0.0025 + 0.5 / 32,
        domain=(0.0, 1.0),
        renormalize=True,
    )
    assert off(edges, golden("dilate_sdist")) < 1e-7
    assert off(weights, golden("dilate_weights")) < 1e-6


def test_golden_interlevel_loss(golden) -> None:
    ours = stepfun.lossfun_outer(
        golden("outer_sdist"), golden("outer_weights"), golden("step_sdist"), golden("alpha_weights")
    )
    assert off(ours, golden("outer_loss")) < 1e-6


@pytest.mark.parametrize("train_frac", ["1.0", "0.3"])
def test_golden_compositing_of_the_model_s_own_weights(golden, train_frac: str) -> None:
    def out(key: str) -> torch.Tensor:
        return golden(f"model_out_{train_frac}/{key}")

    sdist, weights = out("level2_sdist"), out("level2_weights")
    tdist = 4 * sdist + 2 * (1 - sdist)
    assert off(volume.accumulated_alpha(weights), out("acc")) < 1e-6
    assert off(volume.depth_mean(weights, tdist), out("distance_mean")) < 2e-6
    far = torch.full_like(tdist[:, :1], 4.0)
    assert off(volume.depth_median(weights, tdist, far), out("distance_median")) < 2e-5
    loss = losses.predicted_normal_per_ray(weights, out("normals"), out("normals_pred"))
    assert off(loss, out("pred_normal_loss_per_ray")) < 1e-6
