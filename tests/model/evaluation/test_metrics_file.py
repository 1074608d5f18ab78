"""metrics.json: what was measured comes back, and what was changed since is found."""

import json
import subprocess
import sys

import pytest

from preface.artifacts import SCHEMA_DIRECTORY, ArtifactError, sha256
from preface.model.evaluation.evaluate import evaluate_head
from preface.model.evaluation.metrics_file import FIGURES, Measured, read_metrics, write_metrics
from preface.model.evaluation.options import EvaluationOptions
from preface.model.training.prior_files import read_prior

OPTIONS = EvaluationOptions(lpips="vgg", face_half_side=0.05)


@pytest.fixture(scope="module")
def evaluated(prior, dataset):
    return evaluate_head(read_prior(prior), dataset, "id0001", ["camera0", "camera2"], OPTIONS)


@pytest.fixture
def written(evaluated, prior, dataset, tmp_path):
    views = tuple(view.figures for view in evaluated.views)
    measured = Measured("one", read_prior(prior), "id0001", views)
    return evaluated, write_metrics(tmp_path / "metrics.json", measured, dataset, OPTIONS, {"lpips": "vgg"})


def test_every_figure_is_read_as_it_was_measured_to_the_last_bit(written, prior, dataset):
    found, path = written
    content = read_metrics(path)
    assert [view["name"] for view in content["views"]] == ["camera0", "camera2"]
    for view, stored in zip(found.views, content["views"], strict=True):
        assert {name: stored[name] for name in FIGURES if name in stored} == view.figures.values
        assert stored["left_out"] == view.figures.left_out
        assert stored["face"]["side"] == view.figures.face.side
    assert content["mean"] == found.mean
    assert content["kind"] == "prior"
    assert content["fit"] is None
    assert content["settings"]["lpips"]["networks"] == {"lpips": "vgg"}
    assert content["provenance"]["inputs"] == {
        "model.json": sha256(prior / "model.json"),
        "manifest.json": sha256(dataset.manifest.path),
    }


def test_what_a_head_was_fitted_to_goes_with_its_figures(head, dataset, tmp_path):
    known = read_prior(head("a", ["camera0"]))
    found = evaluate_head(known, dataset, "id0000", ["camera0", "camera2"], EvaluationOptions(lpips="none"))
    measured = Measured("a", known, "id0000", tuple(view.figures for view in found.views))
    content = read_metrics(write_metrics(tmp_path / "metrics.json", measured, dataset, OPTIONS, {}))
    assert content["kind"] == "head"
    assert content["fit"]["views"] == ["camera0"]
    assert [view["fitted"] for view in content["views"]] == [True, False]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda c: c["mean"].update(psnr=c["mean"]["psnr"] + 1e-6), "mean.psnr: is .* that of its views"),
        (lambda c: c["views"][1].update(ssim=0.5), "mean.ssim"),
        (lambda c: c["mean"].pop("lpips"), "does not have the figures"),
        (lambda c: c["views"][1].update(name="camera0"), "'camera0' twice"),
        (lambda c: c["views"].clear(), "at least 1"),
        (lambda c: c["views"][0].pop("psnr"), "is missing"),
        (lambda c: c["views"][0].update(psnr_face=101.0), "at most 100"),
        (lambda c: c["views"][0].update(psnr_hair=1.0), "not a known key"),
    ],
)
def test_figures_that_were_changed_are_refused(written, change, words):
    path = written[1]
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))
    with pytest.raises(ArtifactError, match=words):
        read_metrics(path)


def test_the_example_s_means_are_those_of_its_views():
    assert len(read_metrics(SCHEMA_DIRECTORY / "metrics.example.json")["views"]) == 2


def test_the_schema_describes_every_figure_of_views_and_means():
    schema = json.loads((SCHEMA_DIRECTORY / "metrics.schema.json").read_text())
    of_views = set(schema["properties"]["views"]["items"]["properties"])
    assert set(FIGURES) == set(schema["properties"]["mean"]["properties"])
    assert of_views - set(FIGURES) == {"name", "fitted", "degrees_from_fitted", "face", "left_out"}


def test_reading_figures_does_not_wait_for_torch():
    code = "import sys; from preface.model.evaluation import metrics_file; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"
