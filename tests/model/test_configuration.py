"""Configurations: what is read back is what was written, and what cannot be is refused by name."""

import dataclasses
import json
import subprocess
import sys

import pytest

from preface.model.configuration import (
    PRESETS,
    ConfigurationError,
    ModelConfig,
    NetworkConfig,
    carried_levels,
    preset,
)


def test_reading_a_configuration_does_not_load_torch() -> None:
    code = "import sys, preface.model.configuration; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize("name", PRESETS)
def test_presets_survive_json(name: str) -> None:
    assert ModelConfig.from_dict(json.loads(json.dumps(preset(name).to_dict()))) == preset(name)


def test_the_paper_preset_is_what_the_paper_says() -> None:
    paper = preset("paper")
    assert (paper.latent, paper.samples, paper.levels) == (512, (256, 256, 128), 12)
    assert (paper.proposal, paper.nerf) == (NetworkConfig(4, 256), NetworkConfig(8, 1024))
    assert (paper.bottleneck, paper.view_width, paper.view_levels) == (256, 128, 4)
    assert (paper.clip_to_box, paper.background) == (False, "modelled")


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"laten": 3}, "laten: there is no such field; did you mean latent?"),
        ({"nerf": {"depth": 2}}, "nerf: width missing"),
        ({"nerf": {"depth": 2, "width": 8, "widht": 8}}, r"nerf\.widht: .* did you mean width"),
        ({"nerf": 8}, "nerf: 8 is not an object"),
        ({"nerf": {"depth": 0, "width": 8}}, r"nerf\.depth: 0; it has to be 1 or more"),
        ({"latent": -1}, "latent: -1"),
        ({"latent": True}, "latent: True"),
        ({"samples": []}, "samples"),
        ({"samples": [8, 0]}, "samples"),
        ({"levels": 17}, "levels: 17; it has to be 0 to 16, or auto"),
        ({"levels": "many"}, "levels: 'many'"),
        ({"background": "green"}, "background: 'green'; it has to be one of black, captured, modelled"),
        ({"matmul": "fp16"}, "matmul: 'fp16'"),
        ({"clip_to_box": 1}, "clip_to_box: 1; it has to be true or false"),
        ({"code_std": float("nan")}, "code_std: nan"),
        ({"near_anneal_init": 1.5}, "near_anneal_init: 1.5"),
    ],
)
def test_what_cannot_be_is_refused_by_name(data: dict, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        ModelConfig.from_dict(data)


def test_an_unknown_preset_names_the_nearest() -> None:
    with pytest.raises(ConfigurationError, match="no 'smal'; did you mean small"):
        preset("smal")
    with pytest.raises(ConfigurationError, match="there are paper, studio, small, tiny"):
        preset("xyz")


@pytest.mark.parametrize(("height", "levels"), [(144, 10), (384, 12), (2304, 14)])
def test_levels_that_photographs_can_carry(height: int, levels: int) -> None:
    """A camera at 3 units with 1.6 units in the image's height, as FaceScape-like studios have."""
    radius_at_depth_1 = 2 / 12**0.5 * 1.6 / height / 3
    assert carried_levels(radius_at_depth_1 * 3) == levels


@pytest.mark.parametrize(("radius", "levels"), [(1e-30, 16), (1e-5, 16), (1.0, 3), (1e30, 1)])
def test_levels_at_the_ends(radius: float, levels: int) -> None:
    assert carried_levels(radius) == levels


@pytest.mark.parametrize("radius", [0.0, -1.0, float("nan")])
def test_levels_need_a_radius(radius: float) -> None:
    with pytest.raises(ConfigurationError, match="levels: auto needs the radius"):
        carried_levels(radius)


def test_resolving_leaves_a_number_alone() -> None:
    assert preset("paper").resolved(0.5) is preset("paper")
    assert preset("small").resolved(0.0064).levels == 10
    assert dataclasses.replace(preset("small"), levels=3).resolved(0.0064).levels == 3
