"""The README's tables are what the script makes of what is kept, and what is kept is what the benches wrote."""

import copy
import json
import re
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from preface.artifacts import ArtifactError
from preface.model.rendering.shortcuts import QUALITIES, Shortcuts
from speed_for_accuracy import main
from speed_table import keeping, readme
from speed_table.keeping import Kept, read_kept, without_paths
from speed_table.model_stages import STAGES
from speed_table.stages import SCRIPTS, processor_time

ROOT = Path(__file__).parents[3]
MEASURED = ROOT / "tools" / "measured"
EMPTY = "\n".join(line for name in (readme.TABLE, readme.FACES) for line in readme.markers(name))


def kept(source: str, measured: object, of: str = "made up") -> Kept:
    return Kept(Path(f"{source}.json"), source, of, measured)


def rows(table: str) -> list[list[str]]:
    """Cells of the table's rows, without its head."""
    lines = [line for line in table.splitlines() if line.startswith("|")][2:]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def rendered(name: str, group: str, shortcuts, microseconds: float, psnr: float = 30.0) -> dict:
    settings = {"model": 0, "samples": None, "shortcuts": dict(shortcuts.__dict__)}
    figures = {"psnr": psnr, "psnr_to_full": 50.0, "prepare_cpu_s": 2.4, "cpu_us_per_ray": microseconds}
    figures["psnr_to_trained"] = 100.0 if group == "reference" else 51.0
    return {"name": name, "group": group, "settings": settings, "rays": 1000, **figures}


# ------------------------------------------------------------------------------------ this repository


def test_the_readme_is_what_the_script_makes_of_what_is_kept():
    text = (ROOT / "README.md").read_text()
    assert readme.filled(text, read_kept(MEASURED), ROOT / "README.md") == text


def test_what_is_kept_says_what_it_is_of_and_nothing_of_the_machines_folders():
    for one in read_kept(MEASURED):
        assert one.source in SCRIPTS
        assert len(one.of) > 5
        text = one.path.read_text()
        assert json.loads(text)["measured"] == without_paths(one.measured)
        assert not re.search(r"/(tmp|home|root|work|Users)\b", text), one.path


def test_every_script_of_a_stage_is_there():
    for stage in STAGES:
        script = SCRIPTS[stage.source].split()[0]
        assert script.startswith("preface-") or (ROOT / script).is_file(), stage


# ------------------------------------------------------------------------------------------ keeping


@pytest.mark.parametrize(
    ("given", "left"),
    [
        ("/data/takes/board", "board"),
        ("~/pictures/anna.json", "anna.json"),
        ('["/a/b c", "/x/shards96", {}]', '["b c", "shards96", {}]'),
        ("search 1/2", "search 1/2"),
        ("cost / default", "cost / default"),
        ("(read_image + colors) / bare decode", "(read_image + colors) / bare decode"),
        ("https://example.org/a/b", "https://example.org/a/b"),
        ("tools/bench/render_large.py", "tools/bench/render_large.py"),
        ("id0041/head", "id0041/head"),
    ],
)
def test_of_absolute_paths_the_last_part_is_left(given, left):
    assert without_paths(given) == left
    assert without_paths({given: [given, 1.5, None]}) == {left: [left, 1.5, None]}


json_data = st.recursive(
    st.none() | st.booleans() | st.floats(allow_nan=False) | st.text("abc 1/2.~-", max_size=12),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text("ab", max_size=3), inner, max_size=3),
)


@example("/-//1")  # what is left must not look like a path again
@given(json_data)
def test_cleaning_is_done_once_and_changes_strings_only(value):
    once = without_paths(value)
    assert without_paths(once) == once
    assert re.sub(r'"[^"]*"', '""', json.dumps(once)) == re.sub(r'"[^"]*"', '""', json.dumps(value))


def test_a_bench_is_kept_with_every_number_and_the_readme_is_written(tmp_path, capsys):
    measured = {
        "people": ["id0001"],
        "size": "96x144",
        "rows": [
            {"quality": "reference", "normals": True, "cpu_s_per_view": 7.5, "psnr_off": 0.0},
            {"quality": "draft", "normals": False, "cpu_s_per_view": 0.1 + 0.2, "psnr_off": 0.0625},
        ],
        "provenance": {"config": {"shards": "/data/mine/shards"}},
    }
    bench, folder, target = tmp_path / "bench.json", tmp_path / "kept", tmp_path / "README.md"
    bench.write_text(json.dumps(measured))
    target.write_text(f"before\n{EMPTY}\nafter\n")
    flags = ["--measured", str(folder)]
    assert main(["keep", "evaluation", str(bench), "--name", "mine", "--of", "a view; one core", *flags]) == 0
    path = capsys.readouterr().out.strip()
    assert path == str(folder / "evaluation-mine.json")
    expected = copy.deepcopy(measured)
    expected["provenance"]["config"]["shards"] = "shards"
    assert json.loads(Path(path).read_text()) == {
        "source": "evaluation", "of": "a view; one core", "measured": expected
    }  # fmt: skip
    assert main(["write", "--readme", str(target), *flags]) == 0
    assert capsys.readouterr().out.strip() == str(target)
    text = target.read_text()
    assert text.startswith("before\n")
    assert text.endswith("\nafter\n")
    assert rows(text) == [
        ["Evaluate", "**`reference`, with normals**", "7.50 CPU-s per view of 96x144", "none"],
        ["", "`draft`, without normals", "300 CPU-ms per view of 96x144", "PSNR off by at most 0.06 dB"],
    ]
    assert "a view; one core" in text
    assert main(["write", "--readme", str(target), *flags]) == 0
    assert target.read_text() == text


@pytest.mark.parametrize("wrong", ["no", "broken", "folder"])
def test_what_cannot_be_kept_or_written_is_said(tmp_path, capsys, wrong):
    given = tmp_path / "given"
    if wrong == "broken":
        given.write_text("{")
    elif wrong == "folder":
        given.mkdir()
    assert main(["keep", "fit", str(given), "--of", "x", "--measured", str(tmp_path / "kept")]) == 1
    assert "given" in capsys.readouterr().err
    readme_file = tmp_path / "README.md"
    readme_file.write_text(EMPTY + EMPTY)
    assert main(["write", "--readme", str(readme_file), "--measured", str(tmp_path / "kept")]) == 1
    assert "markers" in capsys.readouterr().err
    assert readme_file.read_text() == EMPTY + EMPTY


def test_a_prior_is_measured_by_its_log_of_which_a_later_line_of_a_step_counts(tmp_path, monkeypatch):
    known = SimpleNamespace(
        path=tmp_path / "model.json", step=300, identities=("a", "b"), model=SimpleNamespace(matmul="fp32"),
        configuration={"preset": "tiny", "training": {"identities": 2, "views": 4, "rays": 8}},
        validation={"views": 3, "psnr": 24.25},
    )  # fmt: skip
    known.path.write_text(json.dumps({"resolution": {"width": 96, "height": 144}}))
    lines = [
        {"step": 100, "kind": "train", "rays_per_second": 64},  # 100 steps of 64 rays
        {"step": 200, "kind": "train", "rays_per_second": 1},  # lost, and taken again after an interruption
        {"step": 200, "kind": "validation", "psnr": 20.0},
        {"step": 200, "kind": "train", "rays_per_second": 128},
        {"step": 300, "kind": "train", "rays_per_second": 640},
    ]
    (tmp_path / "log.jsonl").write_text("".join(f"{json.dumps(line)}\n" for line in lines))
    monkeypatch.setattr(keeping, "read_prior", lambda folder: known)
    found = keeping.training_summary(tmp_path)
    assert found["seconds"] == pytest.approx(100 + 50 + 10)
    ((stage, choice, time, error),) = rows(readme.speed_for_accuracy([kept("training", found)]))
    assert (stage, choice) == ("Train, presets", "`tiny`, fp32, 300 steps, 2 people at 96x144")
    assert time == "2.7 min of steps"
    assert error == "24.2 dB on 3 views not trained on"


# -------------------------------------------------------------------------------------------- stages


def test_what_was_not_measured_is_not_there():
    assert readme.speed_for_accuracy([]) == readme.real_faces([]) == ""
    assert readme.filled(f"{EMPTY}\n", [], Path("README.md")).replace("\n", "") == EMPTY.replace("\n", "")
    with pytest.raises(ArtifactError, match="nonsense"):
        readme.filled(EMPTY, [kept("nonsense", {})], Path("README.md"))


def test_calibrations_are_counted_by_their_frames_and_what_failed_is_left_out():
    errors = {"center": 2e-5, "center_bound": 1e-5, "noise": 0.2}
    line = {"scale": "full", "frames": 40, "backend": "own", "seconds": 7.0, "errors": errors}
    measured = {
        "detection": [
            {"scale": "full", "images": 100, "seconds_per_image": 0.5},
            {"scale": "images 1/4", "failed": "too small"},
        ],
        "studio": [line, {**line, "frames": 10, "seconds": 2.0}, {**line, "backend": "x", "errors": None}],
        "simulated": [{**line, "scale": "-", "seconds": 3.0}, {**line, "scale": "-", "errors": None}],
    }
    found = rows(readme.speed_for_accuracy([kept("calibration", measured)]))
    assert [cells[1] for cells in found] == [
        "**full detection, 40 frames, own solver**",
        "full detection, 10 frames, own solver",
        "simulated corners, 40 frames, own solver",
    ]
    assert found[0][2:] == [
        "50 s to detect, 7.0 s to solve",
        "camera centres 0.0200 mm, 2.00 of the Cramer-Rao bound; corners to 0.200 pixels",
    ]
    assert found[2][2] == "3.0 s to solve"
    assert found[1][2] == "12 s to detect, 2.0 s to solve"


def test_alignments_have_no_figures_where_half_of_the_keypoints_are_missing():
    line = {"views": 13, "keypoints": 20, "median mm": 1.5, "RMS mm": 2.8}
    times = {"read s": 0.5, "find s": 2.5, "align s": 1.0}
    views = [
        line,
        {**line, "views": 3, "keypoints": 16},
        {**line, "views": 2, "keypoints": 10},
    ]
    tables = {"scale": [], "crops": [], "views": [{**row, **times} for row in views], "triangulation": []}
    found = rows(readme.speed_for_accuracy([kept("alignment", {"tables": tables})]))
    assert [cells[3] for cells in found] == [
        "keypoints 1.50 mm in the median, 2.80 RMS",
        "keypoints 1.50 mm in the median, 2.80 RMS; 4 of 20 keypoints not found",
        "–; 10 of 20 keypoints not found",
    ]
    assert {cells[2] for cells in found} == {"4.00 CPU-s per person"}


def test_a_render_quality_is_shown_only_as_it_is_now():
    fast, plain = QUALITIES["balanced"], QUALITIES["reference"]
    points = [
        rendered("as trained", "reference", plain, 400.0),
        rendered("all of it", "together", fast, 80.0, 29.9),
        rendered("folded on", "folded", Shortcuts(folded=True), 390.0),
    ]
    of = {"points": {str(number): point for number, point in enumerate(points)}}
    found = rows(readme.speed_for_accuracy([kept("render", of)]))
    assert [cells[1] for cells in found] == ["**`balanced`**", "`reference`", "alone: folded on"]
    # 2.4 s are shared by 24 images of 1000 rays each: 100 us per ray.
    assert found[0][2:] == [
        "180 CPU-us per ray",
        "51.0 dB to the model as trained, 50.0 dB to the fullest render, 29.90 to photographs",
    ]
    assert found[1][3] == "50.0 dB to the fullest render, 30.00 to photographs"
    points[1]["settings"]["shortcuts"]["occupancy"] += 1
    assert [cells[1] for cells in rows(readme.speed_for_accuracy([kept("render", of)]))] == [
        "`reference`",
        "alone: folded on",
    ]


def test_fits_are_means_over_people_and_only_the_front_of_what_is_varied():
    taken = {"ssim": 0.8, "lpips": 0.2, "peak_mib": 1.0}
    points = [
        {"name": "quality balanced", "group": "quality", "cpu_s": 100.0, "psnr": 27.0, "view_cpu_s": 1.5},
        {"name": "quality balanced", "group": "quality", "cpu_s": 140.0, "psnr": 28.0, "view_cpu_s": 2.5},
        {"name": "steps 50", "group": "steps", "cpu_s": 20.0, "psnr": 25.0, "view_cpu_s": 4.0},
        {"name": "rays 128", "group": "rays", "cpu_s": 50.0, "psnr": 24.0, "view_cpu_s": 4.0},
    ]
    of = {"points": {str(number): point | taken for number, point in enumerate(points)}}
    assert rows(readme.speed_for_accuracy([kept("fit", of)])) == [
        [
            "Fit",
            "**`balanced`, fitted and rendered, 2 people**",
            "120 CPU-s, then 2.00 CPU-s per image",
            "27.50 dB, SSIM 0.800, LPIPS 0.200",
        ],
        [
            "",
            "steps 50, 1 person",
            "20 CPU-s, then 4.00 CPU-s per image",
            "25.00 dB, SSIM 0.800, LPIPS 0.200",
        ],
    ]


def test_real_faces_have_a_table_each_with_dashes_where_a_figure_is_missing():
    row = {"person": "someone", "views": 2, "fitted from": "prior", "psnr": 21.506, "lpips_face": 0.25}
    table = readme.real_faces([kept("real-faces", [row, {**row, "views": 3, "psnr": 22.0} | {}], "A walk")])
    assert table.startswith("### Real faces\n\nA walk (`tools/real_faces.py`):")
    assert rows(table)[0] == ["someone", "2", "prior", "21.51", "0.250"]
    del row["lpips_face"]
    other = kept("real-faces", [row, {**row, "lpips_face": 0.5}])
    assert rows(readme.real_faces([other]))[0][-1] == "–"
    assert readme.speed_for_accuracy([other]) == ""


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(75.4, "75 CPU-s"), (1.0, "1.00 CPU-s"), (0.433, "433 CPU-ms"), (4.33e-4, "433 CPU-us")],
)
def test_times_have_a_unit_that_they_can_be_read_in(seconds, words):
    assert processor_time(seconds, "per ray") == f"{words} per ray"
