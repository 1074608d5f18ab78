"""The bench of evaluations, on balls and a prior that was never trained: normals change no figure, shortcuts little."""

import json
import sys
from pathlib import Path

import pytest
import torch

TESTS = Path(__file__).parents[1]
sys.path[:0] = [
    str(TESTS.parent / "tools"),
    str(TESTS / "model" / "training"),
    str(TESTS / "model" / "evaluation"),
]


def test_normals_change_no_figure_and_every_choice_is_measured(tmp_path, capsys):
    import ball_heads
    from untrained import write_model

    from bench.evaluation_choices import main

    (tmp_path / "balls").mkdir()
    ball_heads.write_dataset(tmp_path / "balls")
    names = ["id0000", "id0001"]
    write_model(
        tmp_path / "prior", names, held_out={"id0000": ("camera1",), "id0001": ("camera2", "camera4")}
    )
    output, before = tmp_path / "evaluation.json", torch.get_num_threads()
    shards, model = str(tmp_path / "balls"), str(tmp_path / "prior")
    assert main([shards, model, "--people", *names, "--output", str(output)]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == str(output)
    rows = {(row["quality"], row["normals"]): row for row in json.loads(output.read_text())["rows"]}
    assert set(rows) == {(q, n) for q in ("draft", "balanced", "reference") for n in (True, False)}
    assert all(row["views"] == 3 for row in rows.values())
    for quality in ("draft", "balanced", "reference"):
        assert rows[quality, True]["psnr"] == pytest.approx(rows[quality, False]["psnr"], abs=1e-6)
    assert rows["reference", False]["psnr_off"] == 0
    assert main([shards, str(tmp_path / "nothing"), "--output", str(output)]) == 1
    torch.set_num_threads(before)
