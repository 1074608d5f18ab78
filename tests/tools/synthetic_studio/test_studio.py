"""A whole studio, with a sphere for a head: complete, reproducible, resumable, and never a mixture."""

import dataclasses
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest
import sphere_head

from preface import progress
from preface.capture.images import read_exr, read_header, read_image
from preface.capture.manifest import read_capture
from preface.capture.rig import read_rig
from preface.geometry.transforms import Rigid
from synthetic_studio import estimate
from synthetic_studio.config import BoardConfig, SensorConfig, StudioConfig, StudioError
from synthetic_studio.tasks import Studio, missing_tasks
from synthetic_studio.writer import write_studio

HERE = Path(__file__).parent
SMALL = StudioConfig(
    Path("unused"),
    identities=3,
    views=3,
    resolution="64x96",
    clean_plates=True,
    board=BoardConfig(frames=2),
    jobs=2,
)


def make(output, subject_module="sphere_head", **changes):
    return write_studio(dataclasses.replace(SMALL, output=output, **changes), subject_module)


def contents(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """One studio, made without interruption, that the tests only read."""
    output = tmp_path_factory.mktemp("studio") / "out"
    make(output)
    return output


@pytest.fixture
def copy(finished, tmp_path):
    """A copy of it to damage."""
    return Path(shutil.copytree(finished, tmp_path / "copy"))


def test_the_capture_is_complete_and_as_a_lab_would_deliver_it(finished):
    capture = read_capture(finished / "capture")
    assert not capture.inferred
    assert not capture.missing_views
    assert [camera.id for camera in capture.manifest.cameras] == ["cam00", "cam01", "cam02"]
    assert [take.background for take in capture.manifest.takes] == ["black", "green"]
    assert [subject.take for subject in capture.manifest.subjects] == ["take00", "take00", "take01"]
    assert len(capture.plates) == 6
    for take in capture.manifest.takes:
        names = {tuple(f.name for f in capture.calibration_files(take, f"cam{i:02d}")) for i in range(3)}
        assert names == {("frame000.png", "frame001.png")}
    for path in (finished / "capture").rglob("*.png"):
        header = read_header(path)
        assert (header.width, header.height, header.channels) == (64, 96, 3)
    assert not (finished / "capture" / "masks").exists()


def test_the_truth_is_beside_the_capture_and_agrees_with_the_head(finished):
    truth = finished / "truth"
    rig = read_rig(truth / "takes" / "take01")
    head = sphere_head.Subject(0, 2, None)
    person = json.loads((truth / "identities" / "id0002" / "head.json").read_text())
    assert person["take"] == "take01"
    assert person["keypoints"]["nose_tip"] == head.keypoints["nose_tip"].tolist()
    for name, camera in rig.cameras.items():
        folder = truth / "identities" / "id0002"
        mask = read_image(folder / "mask" / f"{name}.png")[..., 0]
        depth = read_exr(folder / "depth" / f"{name}.exr")["Y"]
        assert mask.dtype == np.uint16
        assert {0, 65535} < set(np.unique(mask))  # and fractions between
        assert np.isnan(depth[mask == 0]).all()
        nearest = np.linalg.norm(camera.camera_from_rig.apply(sphere_head.CENTRE)) - head.radius
        assert np.nanmin(depth) == pytest.approx(nearest, abs=2e-3)
        normals = read_exr(folder / "normals" / f"{name}.exr")
        length = sum(normals[axis].astype(float) ** 2 for axis in "RGB")
        np.testing.assert_allclose(length[~np.isnan(length)], 1, atol=3e-3)


def test_board_poses_and_corners_of_the_truth_agree_with_its_cameras(finished):
    for take in ("take00", "take01"):
        folder = finished / "truth" / "takes" / take
        boards, rig = json.loads((folder / "boards.json").read_text()), read_rig(folder)
        with np.load(folder / "corners.npz") as archive:
            pixels, visible = archive["pixels"], archive["visible"]
        assert visible.any()
        for frame, entry in enumerate(boards["frames"]):
            pose = entry["rig_from_board"]
            rig_from_board = Rigid.from_quaternion(pose["quaternion_wxyz"], pose["translation"])
            corners = rig_from_board.apply(np.array(boards["board"]["corners"]))
            for index, camera in enumerate(rig.cameras.values()):
                expected, _ = camera.camera.project(camera.camera_from_rig.apply(corners))
                np.testing.assert_allclose(pixels[frame, index], expected, atol=1e-9)


def test_the_backdrop_shows_around_the_head(finished):
    subjects = finished / "capture" / "subjects"
    images = [read_image(subjects / who / "cam00.png") for who in ("id0000", "id0002")]
    black, green = (image[:8, :8].mean((0, 1)) for image in images)
    assert black.max() < 6
    assert green[1] > 100 > green[[0, 2]].max()
    plate = read_image(finished / "capture" / "background" / "take01" / "cam00.png")
    np.testing.assert_allclose(plate[:8, :8].mean((0, 1)), green, atol=1.5)


@pytest.mark.parametrize("jobs", [1, 3])
def test_bytes_do_not_depend_on_the_number_of_workers(finished, tmp_path, jobs):
    make(tmp_path / "again", jobs=jobs)
    assert contents(tmp_path / "again") == contents(finished)


def test_another_seed_changes_every_image(finished, tmp_path):
    make(tmp_path / "other", seed=1)
    one, other = contents(finished), contents(tmp_path / "other")
    assert one.keys() == other.keys()
    assert not [name for name in one if one[name] == other[name] and name.endswith((".png", ".exr", ".npz"))]


def test_another_exposure_has_other_noise_and_the_same_scene(finished, tmp_path):
    make(tmp_path / "again", sensor=SensorConfig(exposure_seed=1))
    first, again = contents(finished), contents(tmp_path / "again")
    assert first.keys() == again.keys()
    photographs = {name for name in first if name.startswith("capture/") and name.endswith(".png")}
    told = {"capture/capture.json", "truth/studio.json"}  # they say which exposure it is
    assert {name for name in first if first[name] != again[name]} == photographs | told
    assert "exposure_seed" not in first["capture/capture.json"].decode()
    name = "capture/subjects/id0000/cam00.png"
    difference = read_image(finished / name).astype(float) - read_image(tmp_path / "again" / name)
    assert 0 < np.abs(difference).mean() < 3


def test_an_interrupted_studio_is_finished_byte_for_byte(finished, copy):
    for lost in (
        "capture/capture.json",
        "capture/subjects/id0001/cam02.png",
        "capture/calibration/take01/cam00/frame001.png",
        "capture/background/take00/cam01.png",
        "truth/identities/id0000/depth/cam01.exr",
        "truth/identities/id0002/head.json",
        "truth/takes/take00/rig.json",
    ):
        (copy / lost).unlink()
    shutil.rmtree(copy / "capture" / "subjects" / "id0002")
    (copy / "capture" / "subjects" / "id0001" / ".cam02.png.0123456789ab.tmp").write_bytes(b"half an im")
    make(copy)
    assert contents(copy) == contents(finished)


def test_a_log_tells_what_is_to_be_made_and_how_far_it_is(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(progress, "SECONDS_BETWEEN", 0.0)
    monkeypatch.setattr(progress, "SHARE_BETWEEN", 0.0)
    make(tmp_path / "out", identities=1, takes=1, clean_plates=False, jobs=1)
    lines = capsys.readouterr().err.splitlines()
    assert re.fullmatch(r"9 images to make with 1 worker, about \d+ s by the studio's cost model", lines[0])
    assert lines[-1].startswith("9 of 9 images, ")
    assert any(re.fullmatch(r"[1-8] of 9 images, \d+ s, about \d+ s left", line) for line in lines[1:-1])
    (tmp_path / "out" / "capture" / "subjects" / "id0000" / "cam01.png").unlink()
    make(tmp_path / "out", identities=1, takes=1, clean_plates=False, jobs=1)
    assert capsys.readouterr().err.startswith("1 image to make with 1 worker")


def test_the_steps_of_tasks_add_up_to_the_estimate(tmp_path):
    config = dataclasses.replace(SMALL, output=tmp_path)
    studio = Studio(config, "sphere_head")
    tasks = missing_tasks(studio)
    for task in tasks:
        steps = list(task.steps(studio))
        assert sum(step.images for step in steps) == task.images
        assert sum(step.seconds for step in steps) == pytest.approx(task.seconds(config))
    whole, workers = estimate.estimate(config), config.workers * estimate.START
    assert sum(task.seconds(config) for task in tasks) + workers == pytest.approx(whole.seconds)
    assert sum(task.images for task in tasks) == whole.images


def test_finished_images_are_not_made_again(copy):
    image = copy / "capture" / "subjects" / "id0000" / "cam00.png"
    before = image.stat().st_mtime_ns
    (copy / "capture" / "subjects" / "id0000" / "cam01.png").unlink()
    make(copy)
    assert image.stat().st_mtime_ns == before


@pytest.mark.parametrize(
    ("changes", "names"),
    [
        ({"seed": 1}, "seed: 0 there, 1 now"),
        ({"resolution": "64x97"}, "resolution"),
        ({"identities": 4}, "identities"),
        ({"sensor": SensorConfig(blur=0.5)}, "sensor.blur: 0.4 there, 0.5 now"),
        ({"subject_module": "failing_head"}, "subjects"),
    ],
)
def test_another_configuration_is_refused_and_leaves_the_directory_as_it_was(copy, changes, names):
    before = contents(copy)
    with pytest.raises(StudioError, match=names) as refusal:
        make(copy, **changes)
    assert "--output" in str(refusal.value)
    assert contents(copy) == before


def test_a_directory_of_someone_else_is_refused(tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(StudioError, match="not a studio's"):
        make(tmp_path)
    assert contents(tmp_path) == {"thesis.tex": b"years of work"}


def test_a_failing_view_is_named_and_the_rest_can_be_resumed(tmp_path):
    with pytest.raises(StudioError, match="identity id0001, view cam01: no light on this side"):
        make(tmp_path / "out", subject_module="failing_head")
    assert not (tmp_path / "out" / "capture" / "capture.json").exists()
    assert not list((tmp_path / "out").rglob(".*.tmp"))


def test_calibration_alone_needs_no_people(tmp_path):
    make(tmp_path / "out", identities=0, takes=1, subject_module="no_such_module")
    assert read_capture(tmp_path / "out" / "capture").manifest.subjects == ()


def test_a_full_disk_is_refused_before_the_first_image(tmp_path, monkeypatch):
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=10_000))
    with pytest.raises(StudioError, match="free some space"):
        make(tmp_path / "out")
    assert not (tmp_path / "out" / "capture").exists()


@pytest.mark.skipif(os.name != "posix", reason="sends SIGINT")
def test_ctrl_c_ends_cleanly_and_says_how_to_resume(tmp_path):
    script = tmp_path / "run.py"
    script.write_text(
        textwrap.dedent(
            f"""
            import sys
            sys.path[:0] = {[str(HERE), *sys.path]!r}
            if __name__ == "__main__":
                import synthetic_studio.cli as cli
                from synthetic_studio.writer import write_studio
                cli.write_studio = lambda config: write_studio(config, "sphere_head")
                sys.exit(cli.main(sys.argv[1:]))
            """
        )
    )
    output = tmp_path / "out"
    flags = ["--identities=3", "--views=3", "--resolution=64x96", "--board.frames=2000", "--jobs=2"]
    process = subprocess.Popen(
        [sys.executable, script, f"--output={output}", *flags],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # A shell that runs the tests in the background has told them to ignore what a terminal would send.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    deadline = time.monotonic() + 300
    while not list(output.rglob("frame*.png")) and time.monotonic() < deadline:
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does: parent and workers alike
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 130
    assert "resume" in errors
    assert "Traceback" not in errors
    assert list(output.rglob("frame*.png"))
    assert not (output / "capture" / "capture.json").exists()
    assert not list(output.rglob(".*.tmp"))
