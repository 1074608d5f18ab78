"""``preface-train``: flags, exit statuses, and what it prints."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from preface.cli.train import main, parse
from preface.model.configuration import PRESETS
from preface.model.training.configuration import TRAINING_PRESETS

sys.path.insert(0, str(Path(__file__).parents[1] / "model" / "training"))

SMALL = [
    "--device",
    "cpu",
    "--steps",
    "4",
    "--identities",
    "2",
    "--views",
    "2",
    "--rays",
    "8",
    "--log-every",
    "2",
]
SMALL += [
    "--model.nerf.width",
    "16",
    "--model.nerf.depth",
    "2",
    "--model.samples",
    "6",
    "4",
    "--model.latent",
    "4",
]


@pytest.fixture(scope="module")
def balls(tmp_path_factory):
    import ball_heads

    folder = tmp_path_factory.mktemp("balls")
    ball_heads.write_dataset(folder)
    return folder


def status_of_exit(arguments):
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    return caught.value.code


def test_help_names_every_flag_and_loads_no_torch():
    code = """
import sys
from preface.cli.train import main
try:
    main(["--help"])
finally:
    print("torch" in sys.modules, "numpy" in sys.modules)
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.splitlines()[-1] == "False False"
    for flag in ("--preset", "--output", "--steps", "--micro-rays", "--holdout-views", "--model.nerf.width"):
        assert flag in run.stdout


@pytest.mark.parametrize("preset", sorted(PRESETS))
def test_a_preset_sets_the_defaults_of_all_other_flags(preset):
    config = parse(["shards", "--preset", preset, "--model.latent", "7", f"--steps={11}"])
    training, run = TRAINING_PRESETS[preset]
    assert config.preset == preset
    assert (config.training.steps, config.training.rate) == (11, training.rate)
    assert config.run == run
    assert config.model.latent == 7
    assert config.model.nerf == PRESETS[preset].nerf


def test_the_papers_preset_is_the_papers():
    training = TRAINING_PRESETS["paper"][0]
    assert (training.identities, training.views, training.rays) == (64, 8, 128)
    assert (training.steps, training.rate, training.rate_last, training.clip) == (1_000_000, 2e-3, 2e-5, 1e-3)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "shards"),
        (["shards", "--preset", "huge"], "huge"),
        (["shards", "--model.widht", "3"], "widht"),
        (["shards", "--steps", "many"], "many"),
    ],
)
def test_wrong_usage_is_told_and_ends_with_2(arguments, words, capsys):
    assert status_of_exit(arguments) == 2
    captured = capsys.readouterr()
    assert words in captured.err + captured.out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--steps", "0"], "--steps 0"),
        (["--model.latent", "-1"], "latent"),
        (["--model.samples", "0"], "samples"),
    ],
)
def test_values_that_cannot_be_end_with_2(balls, tmp_path, arguments, words, capsys):
    try:
        status = main([str(balls), "--output", str(tmp_path / "a"), *arguments])
    except SystemExit as ended:  # what the parser itself refuses
        status = ended.code
    assert status == 2
    captured = capsys.readouterr()
    assert words in captured.err + captured.out
    assert not (tmp_path / "a").exists()


def test_the_path_of_the_prior_is_printed_last_and_resuming_changes_nothing(balls, tmp_path, capsys):
    arguments = [str(balls), "--preset", "tiny", "--output", str(tmp_path / "a"), *SMALL]
    assert main(arguments) == 0
    captured = capsys.readouterr()
    assert captured.out.splitlines() == [str(tmp_path / "a" / "model.json")]
    assert "step       4 of 4" in captured.err
    assert "rays/s" in captured.err
    assert "of the matmul peak" in captured.err
    assert main(arguments) == 0
    content = json.loads((tmp_path / "a" / "model.json").read_text())
    assert (content["schema"], content["step"], content["configuration"]["preset"]) == (
        "preface/prior",
        4,
        "tiny",
    )


def test_shards_that_are_not_there_end_with_1(tmp_path, capsys):
    assert main([str(tmp_path / "none"), "--output", str(tmp_path / "a")]) == 1
    assert capsys.readouterr().err.startswith(f"{tmp_path / 'none'}: ")


def test_a_prior_can_be_inspected(balls, tmp_path):
    from preface.cli.inspect_prior import summarise_prior

    main([str(balls), "--preset", "tiny", "--output", str(tmp_path / "a"), *SMALL])
    problems = []
    summary = summarise_prior(tmp_path / "a" / "model.json", problems)
    assert not problems
    assert summary["steps"] == "4 of 4"
    assert summary["identities"] == ["id0000", "id0001", "id0002"]
    assert summary["can_resume"]
    data = bytearray((tmp_path / "a" / "model.safetensors").read_bytes())
    data[-1] ^= 1
    (tmp_path / "a" / "model.safetensors").write_bytes(data)
    summarise_prior(tmp_path / "a" / "model.json", problems)
    assert "sha256" in str(problems[0])


def test_a_folder_of_photographs_is_left_alone_and_an_interrupted_run_resumed(balls, tmp_path, capsys):
    arguments = [str(balls), "--preset", "tiny", "--output", str(tmp_path), *SMALL]
    (tmp_path / "holiday.jpg").write_bytes(b"mine")
    assert main(arguments) == 1
    assert "holds other things than a prior (holiday.jpg)" in capsys.readouterr().err
    assert [file.name for file in tmp_path.iterdir()] == ["holiday.jpg"]
    arguments[arguments.index(str(tmp_path))] = str(balls)  # the shards' own folder
    assert main(arguments) == 1
    assert not (balls / "model.json").exists()


def test_a_run_that_ended_before_its_first_checkpoint_goes_on(balls, tmp_path, monkeypatch):
    from preface.model.training import prior

    def stopped(*arguments):
        raise KeyboardInterrupt

    arguments = [str(balls), "--preset", "tiny", "--output", str(tmp_path / "a"), *SMALL]
    with monkeypatch.context() as patched:
        patched.setattr(prior, "take_steps", stopped)
        assert main(arguments) == 130
    assert (tmp_path / "a" / "log.jsonl").exists()
    assert main(arguments) == 0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "SHARDS"),
        (["shards", "--stps", "3"], "--stps, 3; perhaps --steps was meant"),
        (["shards", "--preset", "huge"], "'huge'"),
        (["shards", "--steps", "many"], "--steps: invalid"),
    ],
)
def test_wrong_usage_is_one_line(arguments, words, capsys):
    assert status_of_exit(arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("preface-train: error: ")
    assert words in line
    assert line.endswith("; see preface-train --help")
