"""``preface-fit`` for photographs: what comes before the fit, stage by stage, and what is said after it.

Cameras and alignment are those of ``preface-align photos``, masks and shards those of ``preface-build-shards``; each is
called with the words that are printed, so that a user may repeat it with others. Everything lies in ``photos/`` of the
head's folder. A stage that was finished with the same photographs and choices is not done again.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import shlex
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from preface.align.alignment_files import INDEX_FILE, TEMPLATE_FILE, read_index, write_template
from preface.align.photos.face import face_prior, keypoint_weights
from preface.align.template import Template, canonical_frame
from preface.artifacts import ArtifactError, provenance, sha256, write_bytes
from preface.capture.images import IMAGE_SUFFIXES
from preface.capture.upright import read_upright_header
from preface.cli import align, build_shards
from preface.cli.align_inputs import template_file
from preface.cli.align_photos import SCHEME
from preface.cli.fit import FitCommand
from preface.cli.folders import make_folder, require_writable
from preface.cli.output import size
from preface.cli.rig_files import RIG_FILE, one_rig_file
from preface.cli.usage import UsageError
from preface.model.fitting.configuration import MAX_VIEWS
from preface.model.pretrained import PRETRAINED, flag_word
from preface.model.training.prior_files import Prior, read_prior
from preface.plain_words import suggestion
from preface.shards.dataset.people import is_capture
from preface.shards.manifest import read_manifest

FOLDER = "photos"  # in the head's
BASELINE_SIZE = (128, 192)  # of the views where there is no prior whose resolution could be taken
# Of the prior's resolution, for `paper`: beyond, a window around the head holds no more pixels.
MAX_MULTIPLE = 8

Say = Callable[[str], None]


class StageError(Exception):
    """A stage that has ended with another exit status than 0, and has said why."""

    def __init__(self, status: int):
        super().__init__(f"exit status {status}")
        self.status = status


@dataclass(frozen=True)
class Prepared:
    """Photographs that are ready to be fitted.

    Attributes:
        alignment: folder of cameras, face and their report.
        shards: folder.
        identity: name.
        views: the photographs that are in the shards, by the names of their cameras.
    """

    alignment: Path
    shards: Path
    identity: str
    views: tuple[str, ...]


def prepare(command: FitCommand, say: Say) -> Prepared:
    """Find cameras and face, cut out the head, and write shards.

    Raises:
        ArtifactError: no photographs, too many, or others than were named.
        UsageError: flags that cannot be.
        StageError: a stage found something wrong.
    """
    files = photographs(command.shards, command.views)
    prior = read_prior(command.prior) if command.from_prior else None
    resolution = view_size(command, prior, files)
    folder = command.output / FOLDER
    alignment, shards = folder / "alignment", folder / "shards"
    require_writable(make_folder(folder))
    template = _template(command, prior, folder, say)
    say(
        f"1 of 3: where {_photographs(len(files))} were taken from and where the face is (about half a minute)"
    )
    # Landmarks of others stand for the photographs in what an alignment records: then it is made anew.
    if not command.photos.landmarks and is_aligned(alignment, files, template, command.photos.cameras):
        say("    finished before, from the same photographs")
    else:
        _stage(align.main, "preface-align", _align_words(command, files, template, alignment), say)
    (entry,) = read_index(alignment).aligned
    width, height = resolution
    say(f"2 of 3: masks, and the views cut out around the head, {width}x{height} pixels")
    words = _shards_words(command, prior, resolution, alignment, shards)
    _stage(build_shards.main, "preface-build-shards", words, say)
    (identity,) = read_manifest(shards).identities
    views = tuple(camera for camera in identity.cameras if camera is not None)
    say(f"3 of 3: the fit to {', '.join(views)}")
    return Prepared(alignment, shards, entry.identity, views)


def explain(prepared: Prepared, command: FitCommand, say: Say) -> None:
    """Say how far a head can be trusted, and write it down beside the shards."""
    from preface.cli.fit_trust import trust
    from preface.model.fitting.run import PREVIEWS

    preview = max((command.output / PREVIEWS).glob("views-*.png"))  # names hold the step, in eight digits
    found = trust(prepared.alignment, prepared.shards, preview, command.from_prior)
    say("How far to trust it:")
    for sentence in found.sentences:
        say(f"    {sentence}")
    folder = prepared.shards.parent
    say(str(found.report(provenance({}, found.inputs), folder).write(folder / "trust.html")))


# ------------------------------------------------------------------------------------- what is asked


def photographs(source: Path, names: Sequence[str]) -> list[Path]:
    """The photographs of a folder, or those that are named, without suffix.

    Raises:
        ArtifactError: none, more than a fit takes, or one that is not there.
    """
    if is_capture(source):
        remedy = "Run preface-align studio and preface-build-shards on it, and give the folder of the shards"
        raise ArtifactError(source, "folder", "is a capture, neither shards nor photographs", remedy)
    found = sorted(f for f in source.iterdir() if f.suffix.lower() in IMAGE_SUFFIXES and f.is_file())
    stems = [file.stem for file in found]
    for name in names:
        if name not in stems:
            problem = f"there is no photograph '{name}'"
            raise ArtifactError(source, "photographs", problem, suggestion(name, stems))
    chosen = [file for file in found if not names or file.stem in names]
    if not chosen:
        problem = f"holds neither shards (manifest.json) nor photographs ({', '.join(IMAGE_SUFFIXES)})"
        raise ArtifactError(source, "folder", problem, "Give one to seven photographs of one person")
    if len(chosen) > MAX_VIEWS:
        some = " ".join(stems[round(place)] for place in np.linspace(0, len(stems) - 1, 3))
        problem = f"there are {len(chosen)}, and a head is fitted to one to seven"
        raise ArtifactError(source, "photographs", problem, f"Name some of them, such as --views {some}")
    return chosen


def view_size(command: FitCommand, prior: Prior | None, files: Sequence[Path]) -> tuple[int, int]:
    """Width and height of the views to fit to: the prior's, which its box fills, in whole multiples for `paper`.

    Smaller photographs are never enlarged.

    Raises:
        UsageError: a resolution that is none.
    """
    if command.photos.resolution != "auto":
        try:
            return size(command.photos.resolution)
        except argparse.ArgumentTypeError as error:
            raise UsageError(f"--photos.resolution: {error}") from error
    width, height = BASELINE_SIZE if prior is None else prior.scene.resolution
    headers = [read_upright_header(file) for file in files]
    room = min(min(header.width / width, header.height / height) for header in headers)
    if room < 1:
        return max(1, math.floor(width * room)), max(1, math.floor(height * room))
    multiple = min(math.floor(room), MAX_MULTIPLE) if command.quality == "paper" else 1
    return multiple * width, multiple * height


def _template(command: FitCommand, prior: Prior | None, folder: Path, say: Say) -> Path:
    """The template to place the face on: the prior's where it is known."""
    if command.photos.template is not None:
        return template_file(command.photos.template)
    if prior is not None:
        beside = prior.path.parent / TEMPLATE_FILE
        if beside.exists():
            # A copy of the one that comes with preface: what is printed and recorded holds wherever that is installed.
            return beside if command.prior != PRETRAINED else _copied(beside, folder / TEMPLATE_FILE)
        say(
            f"note: there is no {TEMPLATE_FILE} beside the prior. The face is placed on the expected one, which "
            "may lie some millimetres from where the prior has its faces; --photos.template names the right one"
        )
    return write_template(folder / TEMPLATE_FILE, expected_template())


def _copied(file: Path, target: Path) -> Path:
    try:
        content = file.read_bytes()
    except OSError as error:
        raise ArtifactError.from_os(file, "reading", error) from error
    return write_bytes(target, content)


def expected_template() -> Template:
    """The five keypoints of the face that is expected of everybody (`preface.align.photos.face`)."""
    face = face_prior()
    keypoints = keypoint_weights() @ face.mean
    varied = np.einsum("mn,nck->mck", keypoint_weights(), face.basis)
    spread = np.sqrt((varied**2).sum(axis=(1, 2)))
    canonical_from_face = canonical_frame(keypoints)
    return Template(
        scheme=SCHEME,
        keypoints=canonical_from_face.apply(keypoints),
        canonical_from_rig=canonical_from_face,
        identities=("expected",),
        procrustes=True,
        spread=spread,
    )


def _photographs(count: int) -> str:
    return "the photograph" if count == 1 else f"{count} photographs"


# ---------------------------------------------------------------------------------------- the stages


def _align_words(command: FitCommand, files: Sequence[Path], template: Path, output: Path) -> list[str]:
    words = ["photos", str(command.shards), "--output", str(output), "--template", flag_word(template)]
    words += ["--identity", command.identity] if command.identity else []
    for flag, given in (("--cameras", command.photos.cameras), ("--landmarks", command.photos.landmarks)):
        words += [flag, str(given)] if given else []
    return [*words, "--only", *(file.stem for file in files)] if command.views else words


def _shards_words(
    command: FitCommand, prior: Prior | None, resolution: tuple[int, int], alignment: Path, output: Path
) -> list[str]:
    words = [str(command.shards), "--rig", str(alignment / RIG_FILE), "--alignment", str(alignment)]
    words += ["--output", str(output), "--resolution", "{}x{}".format(*resolution), "--framing", "box"]
    if prior is not None:  # the space that its weights know; it sets the shards' scale, too
        words += ["--box", *map(repr, prior.scene.box.reshape(-1).tolist())]
    return words + (["--masks", str(command.photos.masks)] if command.photos.masks else [])


def _stage(main: Callable[[Sequence[str]], int], program: str, words: Sequence[str], say: Say) -> None:
    """Run a command; what it prints is not the result of this one and goes where people read.

    Raises:
        StageError: its exit status was not 0.
    """
    say(f"    {shlex.join([program, *words])}")
    began = time.perf_counter()
    try:
        with contextlib.redirect_stdout(sys.stderr):
            status = main(words)
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else 1
    if status:
        raise StageError(status)
    say(f"    done in {time.perf_counter() - began:.0f} s")


def is_aligned(folder: Path, files: Sequence[Path], template: Path, cameras: Path | None) -> bool:
    """Whether an alignment is there that was made from exactly these files.

    Raises:
        ArtifactError: it is damaged, or a file cannot be read.
    """
    if not (folder / INDEX_FILE).exists():
        return False
    inputs = (read_index(folder).provenance or {}).get("inputs", {})
    wanted = [*files, template]
    if cameras is not None:
        wanted.append(one_rig_file(cameras))
    return sorted(inputs.values()) == sorted(sha256(file) for file in wanted)
