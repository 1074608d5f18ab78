"""The bench of training steps: every form computes the same step, whole or in parts, and every row is measured."""

import json
import sys
from pathlib import Path

import pytest
import torch

sys.path[:0] = [str(Path(__file__).parents[2] / "tools")]

COMMAND = ["--presets", "tiny", "--rays", "64", "--micro-rays", "32", "--repeats", "1"]


@pytest.fixture(autouse=True)
def _threads():
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def test_every_form_is_measured_and_sees_the_same_colours(tmp_path, capsys, monkeypatch):
    """A compiler takes longer than all else; one that leaves models as they are stands for it."""
    from bench.training_step import main

    compiled = []

    def compiler(model, backend):
        compiled.append((model.config.matmul, backend))
        return model

    monkeypatch.setattr(torch, "compile", compiler)
    output = tmp_path / "step.json"
    assert main([*COMMAND, "--compile", "--output", str(output)]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == str(output)
    rows = {row["form"]: row for row in json.loads(output.read_text())["rows"]}
    plain = ["concatenated", "factored", "route", "bf16"]
    assert list(rows) == [*plain, "route, compiled", "bf16, compiled"]
    assert compiled == [("fp32", "inductor"), ("bf16", "inductor")]
    for form, row in rows.items():
        assert row["rays_per_cpu_second"] > 0
        assert row["share_of_peak"] > 0
        assert row["rgb_off"] < (2e-2 if form.startswith("bf16") else 1e-5)
    assert rows["concatenated"]["against_concatenated"] == 1
    ratio = rows["bf16"]["rays_per_cpu_second"] / rows["concatenated"]["rays_per_cpu_second"]
    assert rows["bf16"]["against_concatenated"] == pytest.approx(ratio)


def test_a_step_in_parts_is_the_step(tmp_path):
    from bench.training_step import SMALLEST_RADIUS, concatenated, factored, some_rays, train_step
    from preface.model.configuration import preset
    from preface.model.model import PriorModel

    torch.manual_seed(0)
    model = PriorModel(preset("tiny").resolved(SMALLEST_RADIUS), 4)
    rays, jitter = some_rays(128), torch.rand(128, 3)
    gradients = []
    for form, at_a_time in ((concatenated, 128), (factored, 128), (factored, 32)):
        train_step(form, model, rays, jitter, at_a_time)
        gradients.append({name: p.grad.clone() for name, p in model.named_parameters()})
    for other in gradients[1:]:
        for name, gradient in gradients[0].items():
            assert float((gradient - other[name]).norm()) <= 1e-4 * float(gradient.norm()), name


@pytest.mark.parametrize(
    ("flags", "words"),
    [(["--rays", "96", "--micro-rays", "64"], "multiples of 32"), (["--device", "cuda"], "no CUDA device")],
)
def test_what_cannot_be_measured_is_refused(tmp_path, capsys, monkeypatch, flags, words):
    from bench.training_step import main

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(SystemExit) as caught:
        main(["--presets", "tiny", *flags, "--output", str(tmp_path / "step.json")])
    assert caught.value.code == 2
    assert words in capsys.readouterr().err
