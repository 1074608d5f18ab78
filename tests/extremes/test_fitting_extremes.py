"""Fits at the limits: too few or odd views, cameras anywhere, no steps, codes gone astray.

The heads are balls in closed form (`tests/model/training/ball_heads.py`), photographed anew for each case. A fit that
can be done has to explain its views better than the prior did before it, and to leave nothing infinite behind; one that
cannot has to be refused by name.
"""

import math
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

sys.path.insert(0, str(Path(__file__).resolve().parent))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "model" / "fitting"))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "model" / "training"))

import ball_heads
import small_fits
import small_runs
from ball_views import FOCAL, UNSEEN, all_of_one_color, everywhere, names, place, shards_of

from preface.artifacts import ArtifactError
from preface.model.fitting import previews
from preface.model.fitting.finetuning import finetuning_trainer
from preface.model.fitting.heads import head_from_scratch, head_of_prior, with_predicted_normals
from preface.model.fitting.observations import observe
from preface.model.fitting.reduction import reduce_views, reduced_size
from preface.model.fitting.run import fit_head
from preface.model.rays import Rays
from preface.model.rendering.paths import look_at
from preface.model.training.data import WholeViews
from preface.model.training.prior import train_prior
from preface.model.training.prior_files import read_prior
from preface.shards import Dataset, Loader

STILL = {"inversion": {"steps": 0}, "finetuning": {"steps": 0}}


@pytest.fixture(autouse=True)
def _one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(autouse=True)
def _small_previews(monkeypatch):
    """Previews are drawn, but a hundredth of their size: they would take most of the time."""
    monkeypatch.setattr(previews, "PIXELS", 80)


@pytest.fixture(scope="module")
def prior(tmp_path_factory):
    """A prior of three balls."""
    return trained(tmp_path_factory.mktemp("prior"), heads=4)


def trained(folder: Path, heads: int) -> Path:
    """A prior of all of some balls but the last; it knows that heads are round and in the middle."""
    shards = folder / "shards"
    shards.mkdir()
    ball_heads.write_dataset(shards, heads)
    training = {"steps": 40, "views": 4, "rays": 32, "holdout_views": 0}
    config = small_runs.config(shards, folder / "prior", training, {"micro_rays": 512, "faces_between": 0})
    assert train_prior(config, small_runs.quiet).status == 0
    return folder / "prior"


def fit(tmp_path: Path, shards: Path, prior, views, **changes):
    output = tmp_path / f"head{len(list(tmp_path.glob('head*')))}"
    asked = {"inversion": {"steps": 6}, "finetuning": {"steps": 3}, **changes}
    config = small_fits.config(shards, prior, output, views=views, **asked)
    assert fit_head(config, small_fits.quiet).status == 0
    return output


def psnr_of(model, shards: Path, views) -> float:
    """Of some views as a head shows them."""
    with Dataset(shards) as dataset:
        data = observe(dataset, UNSEEN, views, None)
        return small_fits.psnr_of(model, data, data.train.pairs)


def require_sound(head: Path) -> None:
    """All numbers of the head are finite, and so is what it shows where nobody looked."""
    described = read_prior(head)
    model = described.load_model()
    assert all(parameter.isfinite().all() for parameter in model.state_dict().values())
    assert described.finished
    assert described.identities == (UNSEEN,)
    seen = rendered(head, model, model.codes if model.config.latent else None)
    assert seen.isfinite().all()
    assert ((seen >= -0.0011) & (seen <= 1.0011)).all()


def rendered(head: Path, model, code) -> torch.Tensor:
    """All pixels of views from behind and above, as no head is fitted to, with any model."""
    poses = [place(180.0), place(0.0, 80.0)]
    folder = head.parent / f"around-{head.name}"
    if not folder.exists():
        shards_of(folder, poses)
    with Dataset(folder) as dataset:
        data = observe(dataset, UNSEEN, names(2), None)
        loader = Loader(
            data.dataset,
            WholeViews(data.train, data.train.pairs),
            placement="mmap",
            scale=data.scene.scene_scale,
        )
        with torch.no_grad():
            return torch.cat([model(Rays.from_batch(loader.batch(i)), code).rgb for i in range(2)])


def require_better(tmp_path: Path, shards: Path, prior, views, **changes) -> Path:
    """A fit explains its views better than the prior does with a code of zeros, and is sound."""
    networks = read_prior(prior).load_model()
    start = head_of_prior(networks, torch.zeros(networks.config.latent))
    head = fit(tmp_path, shards, prior, views, **changes)
    assert psnr_of(read_prior(head).load_model(), shards, views) > psnr_of(start, shards, views)
    require_sound(head)
    return head


RING = [
    place(azimuth, elevation)
    for azimuth, elevation in zip(range(-60, 61, 20), (0, 15, -15, 0, 15, -15, 0), strict=True)
]
CASES = {
    "one view": ([place(0.0)], {}),
    "seven views": (RING, {}),
    "two views from one side, three degrees apart": ([place(60.0), place(63.0)], {}),
    "the same view twice": ([place(10.0), place(10.0)], {}),
    "from behind only": ([place(170.0), place(-170.0)], {}),
    "masks full": ([place(-20.0), place(20.0)], {"change": everywhere(255)}),
    "masks that are nowhere sure": ([place(-20.0), place(20.0)], {"change": everywhere(1)}),
    "saturated views": ([place(-20.0), place(20.0)], {"change": all_of_one_color(255)}),
    "black heads on black": ([place(-20.0), place(20.0)], {"change": all_of_one_color(0)}),
    "views of 16x16 pixels": ([place(-20.0), place(20.0)], {"size": (16, 16), "focal": FOCAL / 2}),
    "cameras inside the box": ([place(0.0, 0.0, 0.1285), place(40.0, 0.0, 0.14)], {"focal": 12.0}),
    "cameras 100 m away": (
        [place(-20.0, 0.0, 100.0), place(20.0, 0.0, 100.0)],
        {"focal": 100 * FOCAL},
    ),
    "cameras 3 cm from each other that see a pupil each": (
        [place(20.0, 11.0, 1.0), place(22.0, 11.0, 1.0)],
        {"focal": 20 * FOCAL},
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_a_fit_explains_its_views_better_than_the_prior_did(name, prior, tmp_path):
    poses, options = CASES[name]
    shards = shards_of(tmp_path / "shards", poses, **options)
    head = require_better(tmp_path, shards, prior, names(len(poses)))
    assert read_prior(head).fit["views"] == list(names(len(poses)))


@pytest.mark.parametrize(
    ("azimuths", "change", "words"),
    [
        ((-20.0, 20.0), lambda pixels: pixels[1].fill(0), "view1 .* no foreground"),
        ((-20.0, 20.0), everywhere(0), "view0 .* no foreground"),
        ((-20.0, None), everywhere(255), "view1 .* outside the box"),
    ],
    ids=["one view without foreground", "masks empty", "a camera that looks away"],
)
def test_a_view_that_shows_nothing_of_the_head_is_refused_by_name(azimuths, change, words, prior, tmp_path):
    away = look_at(np.array([0.0, 0.0, 1.0]), np.array([0.3, 0.0, 2.0]))
    poses = [away if azimuth is None else place(azimuth) for azimuth in azimuths]
    shards = shards_of(tmp_path / "shards", poses, change=change)
    config = small_fits.config(shards, prior, tmp_path / "head", views=names(2))
    with pytest.raises(ArtifactError, match=words):
        fit_head(config, small_fits.quiet)
    assert not (tmp_path / "head").exists()


def test_no_steps_leave_the_prior_with_a_code_of_zeros(prior, tmp_path):
    shards = shards_of(tmp_path / "shards", [place(0.0)])
    head = fit(tmp_path, shards, prior, names(1), **STILL)
    require_sound(head)
    described, model = read_prior(head), read_prior(prior).load_model()
    zeros = torch.zeros(1, model.config.latent)
    ours = described.load_model()
    assert torch.equal(ours.codes.detach(), zeros)
    assert torch.equal(rendered(head, ours, ours.codes), rendered(head, model, zeros))
    assert described.steps == 0


def test_no_steps_without_a_prior_leave_the_random_weights_of_the_seed(tmp_path):
    shards = shards_of(tmp_path / "shards", [place(0.0)])
    for seed in (0, 1):
        head = fit(tmp_path, shards, "none", names(1), seed=seed, **STILL)
        require_sound(head)
        described = read_prior(head)
        expected = head_from_scratch(described.model, seed).state_dict()
        assert all(torch.equal(v, expected[n]) for n, v in described.load_model().state_dict().items())


@pytest.fixture(scope="module")
def lonely(tmp_path_factory):
    """A prior of one identity."""
    return trained(tmp_path_factory.mktemp("lonely"), heads=2)


@pytest.mark.parametrize("start", ["mean", "furthest"])
def test_a_prior_of_one_identity_is_its_own_mean_and_its_own_neighbour(start, lonely, tmp_path):
    shards = shards_of(tmp_path / "shards", [place(0.0)])
    head = fit(tmp_path, shards, lonely, names(1), **{**STILL, "inversion": {"steps": 0, "start": start}})
    codes = read_prior(lonely).load_model().codes
    assert codes.shape[0] == 1
    assert torch.equal(read_prior(head).load_model().codes, codes)


def test_a_prior_of_one_identity_is_fitted_as_any(lonely, tmp_path):
    shards = shards_of(tmp_path / "shards", [place(-20.0), place(20.0)])
    require_better(tmp_path, shards, lonely, names(2))


@pytest.mark.parametrize("rate", [1e3, 1e12, 1e30])
def test_a_code_that_is_thrown_out_of_all_bounds_ends_in_a_sound_head(rate, prior, tmp_path):
    shards = shards_of(tmp_path / "shards", [place(-20.0), place(20.0)])
    changes = {"inversion": {"steps": 5, "rate": rate}, "finetuning": {"steps": 2}}
    head = fit(tmp_path, shards, prior, names(2), **changes)
    require_sound(head)


def test_constant_patches_have_a_perceptual_gradient_that_is_finite(prior, tmp_path):
    change = lambda pixels: (everywhere(255)(pixels), all_of_one_color(255)(pixels))  # noqa: E731
    shards = shards_of(tmp_path / "shards", [place(-20.0), place(20.0)], change=change)
    inversion = {"steps": 3, "patch": 32, "lpips": 0.2}
    require_better(tmp_path, shards, prior, names(2), inversion=inversion)


def test_views_too_small_for_the_perceptual_loss_are_refused_with_the_way_out(prior, tmp_path):
    shards = shards_of(tmp_path / "shards", [place(0.0)], size=(15, 40))
    config = small_fits.config(shards, prior, tmp_path / "head", {"lpips": 0.2, "patch": 32}, views=names(1))
    with pytest.raises(ArtifactError, match=r"15x40 hold no patch of 16x16.*--inversion\.lpips 0"):
        fit_head(config, small_fits.quiet)


def test_views_of_4096_pixels_are_reduced_to_the_priors_size_and_finetuned_at_theirs(prior, tmp_path):
    # A strip as wide as the largest images. Each row of the ball is as the next, so that its mean is known.
    shards = shards_of(tmp_path / "shards", [place(0.0)], size=(4096, 8), focal=4096 / 24 * FOCAL)
    with Dataset(shards) as dataset:
        data = observe(dataset, UNSEEN, names(1), read_prior(prior))
        size = reduced_size((4096, 8), (24, 32))
        assert size == (627, 1)  # the aspect kept, and 768 pixels as nearly as whole rows allow
        reduce_views(data, size, tmp_path / "reduced")
        mask = dataset.pixels(0, 0)[..., 3].astype(float)
        model = with_predicted_normals(head_of_prior(read_prior(prior).load_model(), torch.zeros(8)), 0)
        trainer, loader = finetuning_trainer(
            model, small_fits.FINETUNING, 8, data, 0, 64, torch.device("cpu"), knows_heads=True
        )
        outcome = trainer.step(0, loader.batch(0))
    assert math.isfinite(outcome.loss)
    assert all(parameter.isfinite().all() for parameter in model.parameters())
    with Dataset(tmp_path / "reduced") as reduced:
        found = reduced.pixels(0, 0)[..., 3].astype(float)
        np.testing.assert_allclose(found.mean(), mask.mean(), atol=0.5)
        focal = float(reduced.tables["intrinsics"][0, 0, 0])
    assert focal == pytest.approx(
        627 / 24 * FOCAL
    )  # pixels are continuous: the focal length goes with the width
