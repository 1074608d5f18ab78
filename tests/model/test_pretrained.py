"""The prior that comes with preface, whichever it is: how it is named and found, and what is said without it."""

import fnmatch
import sys
import tomllib
from pathlib import Path

import pytest

from preface.artifacts import ArtifactError
from preface.model import pretrained
from preface.model.fitting.configuration import FitConfig
from preface.model.pretrained import FILES, flag_word, pretrained_folder, prior_flag, prior_path
from preface.model.training.prior_files import read_prior

for folder in ("training", "evaluation"):
    sys.path.insert(0, str(Path(__file__).parent / folder))


@pytest.fixture
def box(tmp_path, monkeypatch):
    """A package's folder with a prior of two people."""
    from untrained import write_model

    folder = write_model(tmp_path / "package", ["id0000", "id0001"])
    for name in ("template.json", "MODEL_CARD.md"):
        (folder / name).write_text("{}")
    monkeypatch.setattr(pretrained, "FOLDER", folder)
    return folder


def test_the_word_means_the_prior_in_the_package_and_a_path_of_that_name_does_not(box, tmp_path, monkeypatch):
    assert pretrained_folder() == box
    assert read_prior("pretrained").path == box / "model.json"
    monkeypatch.chdir(tmp_path)
    assert prior_path(Path("pretrained")) == Path("pretrained")
    with pytest.raises(ArtifactError, match=r"^pretrained: file: no such file"):
        read_prior(Path("pretrained"))


def test_flags_keep_the_word_and_take_everything_else_as_a_path():
    assert prior_flag("pretrained") == "pretrained"
    assert prior_flag("./pretrained") == Path("pretrained")
    assert isinstance(prior_flag("./pretrained"), Path)
    for given in ("pretrained", Path("pretrained"), Path("a/pretrained"), Path("/a/prior")):
        read = prior_flag(flag_word(given))
        assert (read, type(read)) == (given, type(given))


@pytest.mark.parametrize("gone", FILES)
def test_an_installation_without_a_part_of_it_says_so_and_what_to_do(box, gone):
    (box / gone).unlink()
    with pytest.raises(ArtifactError, match=f"installed without it \\({gone} missing\\).*--prior none"):
        read_prior("pretrained")


def test_every_file_of_it_is_package_data():
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())
    patterns = project["tool"]["setuptools"]["package-data"]["preface"]
    for name in FILES:
        assert any(fnmatch.fnmatch(f"model/pretrained/{name}", pattern) for pattern in patterns), name


def test_a_fit_starts_from_it_unless_told_otherwise():
    config = FitConfig(Path("shards"))
    assert config.prior == "pretrained"
    assert config.from_prior
    assert not FitConfig(Path("shards"), prior="none").from_prior
