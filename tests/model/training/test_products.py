"""Which products a run forms: those that are wanted, and only where they are what float32 stands for."""

import pytest
import torch

from preface.model.configuration import ModelConfig, NetworkConfig
from preface.model.matmul import FP32_ERROR, Route, measure_route
from preface.model.training import products
from preface.model.training.configuration import TrainingConfigError
from preface.model.training.products import chosen_products

CPU = torch.device("cpu")
MODEL = ModelConfig(nerf=NetworkConfig(2, 64))


def error_of_products() -> float:
    torch.manual_seed(0)
    a, b = torch.randn(512, 512), torch.randn(512, 512)
    exact = a.double() @ b.double()
    return float(((a @ b) - exact).abs().max() / exact.abs().max())


@pytest.mark.parametrize("wanted", ["auto", "mkl", "onednn"])
def test_float32_products_are_exact_or_the_flag_is_refused(wanted):
    """oneDNN's are on processors without products of bfloat16, and are not on others."""
    if wanted == "onednn" and measure_route("onednn", CPU, 512).error > FP32_ERROR:
        with pytest.raises(TrainingConfigError, match=r"--products onednn: .* give --products auto"):
            chosen_products(MODEL, "", wanted, CPU).__enter__()
    else:
        with chosen_products(MODEL, "", wanted, CPU) as route:
            assert wanted in ("auto", route.name)
            assert error_of_products() <= FP32_ERROR
    assert error_of_products() <= FP32_ERROR


@pytest.fixture
def rounding_onednn(monkeypatch):
    """A processor whose oneDNN rounds to bfloat16."""
    monkeypatch.setattr(products, "choose_route", lambda *_: Route("mkl", 100.0, 0.0))
    monkeypatch.setattr(products, "_is_exact", lambda: False)


@pytest.mark.usefixtures("rounding_onednn")
def test_products_that_round_are_refused_when_asked_for_and_left_when_they_come_from_elsewhere():
    with (
        pytest.raises(TrainingConfigError, match=r"--products onednn: .*bfloat16.* --products auto"),
        chosen_products(MODEL, "", "onednn", CPU),
    ):
        pass
    with chosen_products(MODEL, "onednn", "auto", CPU) as route:  # a run that was begun on another processor
        assert route.name == "mkl"
