"""More levels of the encoding render what fewer did, and fewer what is left when the highest are silent."""

import dataclasses

import pytest
import torch
from test_model import SMALL, model_of, some_rays

from preface.model.configuration import ConfigurationError, NetworkConfig
from preface.model.levels import with_levels
from preface.model.networks import Trunk

# The encoding is appended within the trunk, behind it (for density, bottleneck and normals), or nowhere.
TRUNKS = {"within": 6, "behind": 5, "nowhere": 3}


def model(depth: int, latent: int = 12):
    nerf = NetworkConfig(depth, 32)
    config = dataclasses.replace(SMALL, nerf=nerf, latent=latent, predicted_normals=True, levels=6)
    return model_of(config, 2 if latent else 1)


def render(found, rays, code):
    return found(rays, code, normals=True)


@pytest.mark.parametrize("depth", TRUNKS.values(), ids=TRUNKS)
@pytest.mark.parametrize("levels", [7, 16])
@pytest.mark.parametrize("latent", [12, 0])
def test_new_levels_change_nothing_at_first(depth, levels, latent):
    before = model(depth, latent)
    after = with_levels(before, levels)
    assert after.config == dataclasses.replace(before.config, levels=levels)
    rays, code = some_rays(16), before.codes[:1] if latent else None
    ours, theirs = (render(one, rays, code) for one in (after, before))
    for name in ("rgb", "acc", "distance_mean", "normals", "normals_pred"):
        torch.testing.assert_close(getattr(ours, name), getattr(theirs, name), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("depth", TRUNKS.values(), ids=TRUNKS)
def test_new_levels_are_learned_wherever_the_encoding_is_seen(depth):
    after = with_levels(model(depth), 8)
    seen = render(after, some_rays(64), after.codes[:1])
    (seen.rgb.sum() + seen.normals_pred.sum() + seen.levels[0].weights.square().sum()).backward()
    inputs = 2 * 8 * 21
    weights = {name: p for name, p in after.named_parameters() if p.dim() == 2 and p.shape[1] >= inputs}
    assert len(weights) == {6: 3, 5: 5, 3: 2}[depth]
    for name, weight in weights.items():
        new = weight.grad[:, -inputs:].view(-1, 2, 8, 21)[:, :, 6:]
        assert new.abs().amax(dim=(0, 3)).min() > 0, name


@pytest.mark.parametrize("depth", TRUNKS.values(), ids=TRUNKS)
def test_levels_that_are_left_out_are_as_if_their_waves_were_flat(depth, monkeypatch):
    before = model(depth)
    fewer = with_levels(before, 4)
    rays = some_rays(16)
    rendered = render(fewer, rays, before.codes[:1])
    usual = Trunk.trunk

    def silenced(self, encoding, *rest):
        kept = torch.arange(2 * 6 * 21) // 21 % 6 < 4
        return usual(self, encoding * kept, *rest)

    monkeypatch.setattr(Trunk, "trunk", silenced)
    torch.testing.assert_close(rendered.rgb, render(before, rays, before.codes[:1]).rgb, rtol=1e-5, atol=1e-5)


def test_there_and_back_is_the_same_model():
    before = model(6)
    for name, value in with_levels(with_levels(before, 9), 6).state_dict().items():
        assert torch.equal(value, before.state_dict()[name]), name
    with pytest.raises(ConfigurationError, match="levels: 17"):
        with_levels(before, 17)
