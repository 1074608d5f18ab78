"""Reports as a browser and as a program read them: structure, escaping, self-containment, the JSON twin."""

import base64
import hashlib
import io
import json
import math
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from preface.artifacts import ArtifactError, read_artifact
from preface.reports import KeyFigure, Link, Report, Target, new_figure
from preface.reports.values import shown

HOSTILE = "</title></style></script><script>alert(1)</script><img src=x onerror=alert(2)>\"'&{{ 7 * 7 }}"
VOID = {"meta", "img", "br", "link", "input", "hr"}


class Page(HTMLParser):
    """Elements in order as (tag, attributes, text); fails on tags that do not nest."""

    def __init__(self, text: str):
        super().__init__()
        self.elements: list[tuple[str, dict, list[str]]] = []
        self.open: list[tuple[str, dict, list[str]]] = []
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attrs):
        assert len(dict(attrs)) == len(attrs)
        self.elements.append((tag, dict(attrs), []))
        if tag not in VOID:
            self.open.append(self.elements[-1])

    def handle_endtag(self, tag):
        assert self.open.pop()[0] == tag

    def handle_data(self, data):
        for element in self.open:
            element[2].append(data)

    def all(self, tag):
        return [(attrs, "".join(text).strip()) for name, attrs, text in self.elements if name == tag]

    def texts(self, tag):
        return [text for _, text in self.all(tag)]


def sample_report() -> Report:
    report = Report("Take 2", {"seed": 7, "versions": {"torch": "2.13.0"}, "config": {"sizes": [1, 2]}})
    section = report.section("Cameras", "First paragraph.\n\nSecond.")
    section.key_figures(
        [
            KeyFigure("error", np.float64(1 / 3), "px", Target(at_most=0.3)),
            KeyFigure("views", np.int64(321), target=Target(at_least=100)),
            KeyFigure("unknown", math.nan, "mm", Target(at_most=1)),
            KeyFigure("model", "OPENCV"),
        ]
    )
    section.table(
        [
            {"camera": "C00", "rms": 0.1},
            {"camera": "C01", "rms": math.nan, "note": Path("a/b.png")},
            {"camera": "C02", "rms": 1 / 3, "ok": True},
            {"camera": "C03", "rms": math.inf},
        ],
        "Reprojection",
        units={"rms": "px"},
        sort_by="rms",
        targets={"rms": Target(at_most=0.3)},
    )
    section.image(np.random.default_rng(0).integers(0, 255, (20, 30, 3), np.uint8), "Noise", "noise", "png")
    figure = new_figure(4, 3)
    figure.axes[0].plot([1, 2, 3])
    figure.axes[0].set_title("loss")
    section.plot(figure, "Loss", "a rising line", "svg")
    return report


def written(report: Report, folder: Path) -> tuple[Page, dict]:
    path = report.write(folder / "report.html")
    return Page(path.read_text(encoding="utf-8")), read_artifact(folder / "report.json", "preface/report")


def test_the_page_shows_every_section_with_its_blocks_in_order(tmp_path):
    page, _ = written(sample_report(), tmp_path)
    assert page.texts("h1") == page.texts("title") == ["Take 2"]
    assert page.texts("h2") == ["Cameras", "Provenance"]
    assert page.texts("p") == ["First paragraph.", "Second."]
    order = [t for t, a, _ in page.elements if t in ("p", "dl", "table", "img")]
    assert order == ["p", "p", "dl", "table", "img", "img", "dl"]


def test_a_table_is_sorted_with_missing_values_last_and_marks_missed_targets(tmp_path):
    page, twin = written(sample_report(), tmp_path)
    headers = [(a["scope"], text) for a, text in page.all("th")]
    assert [text for scope, text in headers if scope == "row"] == ["C03", "C02", "C00", "C01"]
    assert [text.split()[0] for scope, text in headers if scope == "col"] == ["camera", "rms", "note", "ok"]
    sorted_columns = [(text.split()[0], a["aria-sort"]) for a, text in page.all("th") if "aria-sort" in a]
    assert sorted_columns == [("rms", "descending")]
    missed = [text for a, text in page.all("td") if "missed" in a.get("class", "")]
    assert missed == ["✗ ∞", "✗ 0.3333"]
    table = twin["sections"][0]["blocks"][2]
    assert [row["camera"] for row in table["rows"]] == ["C03", "C02", "C00", "C01"]


def test_ascending_order_also_puts_missing_values_last():
    report = Report("t", {})
    rows = [{"v": 2.0}, {"v": None}, {"v": math.nan}, {"v": -1}]
    report.section("s").table(rows, "c", sort_by="v", descending=False)
    assert [row["v"] for row in report.twin()["sections"][0]["blocks"][0]["rows"]] == [-1, 2.0, None, None]


def test_the_twin_holds_the_same_numbers_as_the_page_at_full_precision(tmp_path):
    page, twin = written(sample_report(), tmp_path)
    on_page = [float(a["value"]) for a, _ in page.all("data")]
    figures, table = twin["sections"][0]["blocks"][1:3]
    values = [f["value"] for f in figures["figures"]] + [v for row in table["rows"] for v in row.values()]
    numbers = [float(v) for v in values if v == "Infinity" or (isinstance(v, (int, float)) and v is not True)]
    assert on_page == numbers
    assert 1 / 3 in numbers
    assert [f["met"] for f in figures["figures"]] == [False, True, None, None]


def test_not_a_number_is_a_dash_on_the_page_and_null_in_the_twin(tmp_path):
    page, twin = written(sample_report(), tmp_path)
    row = next(r for r in twin["sections"][0]["blocks"][2]["rows"] if r["camera"] == "C01")
    assert row["rms"] is None
    assert row["note"] == "a/b.png"
    assert any(text.split()[0] == "–" for a, text in page.all("dd"))
    assert "NaN" not in (tmp_path / "report.json").read_text()


def test_pictures_are_inside_the_page_and_the_twin_names_their_hash(tmp_path):
    page, twin = written(sample_report(), tmp_path)
    sources = [a["src"] for a, _ in page.all("img")]
    contents = [base64.b64decode(source.partition(",")[2], validate=True) for source in sources]
    pictures = twin["sections"][0]["blocks"][3:]
    assert [hashlib.sha256(c).hexdigest() for c in contents] == [p["sha256"] for p in pictures]
    assert [source.partition(";")[0] for source in sources] == ["data:image/png", "data:image/svg+xml"]
    expected = np.random.default_rng(0).integers(0, 255, (20, 30, 3), np.uint8)
    np.testing.assert_array_equal(np.array(Image.open(io.BytesIO(contents[0]))), expected)
    assert [(p["width"], p["height"]) for p in pictures] == [(30, 20), (384, 288)]


def test_a_jpeg_shows_the_same_picture_nearly():
    ramp = np.broadcast_to(np.linspace(0, 1, 64)[:, None, None], (64, 64, 3))
    report = Report("t", {})
    report.section("s").image(ramp, "c", "a", "jpeg")
    uri = re.search(r'src="(data:image/jpeg;base64,[^"]+)"', report.html()).group(1)
    decoded = np.array(Image.open(io.BytesIO(base64.b64decode(uri.partition(",")[2]))))
    assert np.abs(decoded - ramp * 255).max() < 6


def test_nothing_outside_the_page_is_needed(tmp_path):
    path = sample_report().write(tmp_path / "report.html")
    text = path.read_text(encoding="utf-8")
    page = Page(text)
    assert not [tag for tag, _, _ in page.elements if tag in ("link", "iframe", "object", "embed", "base")]
    for _, attrs, _ in page.elements:
        for name in ("src", "href", "srcset", "action", "data", "poster"):
            assert attrs.get(name, "#").startswith(("#", "data:image/"))
    without_pictures = re.sub(r"data:image/[^\"]+", "", text)
    assert not re.search(r"https?:|//\w|@import|url\(", without_pictures)
    policy = next(a for a, _ in page.all("meta") if a.get("http-equiv") == "Content-Security-Policy")
    assert "default-src 'none'" in policy["content"]


def test_readers_who_cannot_see_find_names_for_everything(tmp_path):
    page, _ = written(sample_report(), tmp_path)
    assert page.all("html")[0][0]["lang"] == "en"
    assert [a["alt"] for a, _ in page.all("img")] == ["noise", "a rising line"]
    ids = [a["id"] for _, a, _ in page.elements if "id" in a]
    assert len(ids) == len(set(ids))
    referenced = {a["aria-labelledby"] for _, a, _ in page.elements if "aria-labelledby" in a}
    assert referenced <= set(ids)
    assert all(a.get("aria-label") for a, _ in page.all("button"))
    assert page.texts("figcaption") == ["Reprojection", "Noise", "Loss"]


def test_hostile_words_stay_words_wherever_they_appear(tmp_path):
    report = Report(HOSTILE, {HOSTILE: HOSTILE, "list": [HOSTILE, {HOSTILE: HOSTILE}]})
    section = report.section(HOSTILE, HOSTILE)
    section.key_figures([KeyFigure(HOSTILE, HOSTILE, HOSTILE, Target(at_most=1))])
    section.table([{HOSTILE: HOSTILE, "n": 1}], HOSTILE, units={"n": HOSTILE})
    section.image(np.zeros((2, 2)), HOSTILE, HOSTILE, "png")
    page, twin = written(report, tmp_path)
    assert len(page.all("script")) == 1  # ours
    assert len(page.all("img")) == 1
    assert not any(name.startswith("on") for _, a, _ in page.elements for name in a)
    assert page.texts("title") == page.texts("h1") == page.texts("p") == [HOSTILE]
    assert page.all("img")[0][0]["alt"] == HOSTILE
    assert twin["title"] == HOSTILE


def test_a_name_that_is_not_valid_unicode_does_not_stop_the_report(tmp_path):
    report = Report("t", {})
    report.section("s").table([{"file": "caf\udce9.png"}], "c")
    page, _ = written(report, tmp_path)
    assert "caf" in page.texts("th")[1]


def test_the_same_input_gives_the_same_bytes(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        sample_report().write(tmp_path / name / "report.html")
    for file in ("report.html", "report.json"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


def test_the_navigation_appears_from_three_sections_on_and_leads_to_them():
    report = Report("t", {})
    for name in "abc":
        assert "<nav" not in report.html()
        report.section(name)
    page = Page(report.html())
    targets = [a["href"].removeprefix("#") for a, _ in page.all("a")]
    assert targets == [a["id"] for a, _ in page.all("section") if a["id"]]


def test_provenance_is_flattened_on_the_page_and_kept_in_the_twin(tmp_path):
    page, twin = written(sample_report(), tmp_path)
    lines = dict(zip(page.texts("dt")[-3:], page.texts("dd")[-3:], strict=True))
    assert lines == {"seed": "7", "versions.torch": "2.13.0", "config.sizes": "1, 2"}
    assert twin["provenance"] == {"seed": 7, "versions": {"torch": "2.13.0"}, "config": {"sizes": [1, 2]}}


def test_the_page_leaves_out_provenance_that_there_is_none_of_and_the_twin_keeps_it(tmp_path):
    history = {"config": {}, "seed": None, "inputs": {"given": None}}
    page, twin = written(Report("Empty", history), tmp_path)
    assert page.texts("dt") == ["inputs.given"]
    assert twin["provenance"] == history


def test_the_worked_example_of_the_schema_is_a_valid_report():
    specs = Path(__file__).parents[2] / "data_specs"
    example = read_artifact(specs / "report.example.json", "preface/report")
    kinds = {block["kind"] for section in example["sections"] for block in section["blocks"]}
    assert kinds == {"text", "key_figures", "table", "picture"}


@pytest.mark.parametrize(
    "change",
    [
        lambda b: b[0].update(kind="video"),
        lambda b: b[0].update(html="<b>"),
        lambda b: b[1]["figures"][0].pop("unit"),
        lambda b: b[2]["rows"][0].update(rms=[1]),
        lambda b: b[2]["columns"][1].update(target={"at_most": 1}),
        lambda b: b[3].update(alt=""),
        lambda b: b[3].update(sha256="abc"),
    ],
)
def test_the_schema_refuses_a_twin_that_is_not_one(tmp_path, change):
    twin = sample_report().twin()
    blocks = twin["sections"][0]["blocks"]
    change(blocks)
    (tmp_path / "x.json").write_text(json.dumps(twin))
    with pytest.raises(ArtifactError):
        read_artifact(tmp_path / "x.json", "preface/report")


def test_a_report_that_cannot_be_written_says_where(tmp_path):
    with pytest.raises(ArtifactError, match="nowhere"):
        sample_report().write(tmp_path / "nowhere" / "report.html")
    with pytest.raises(ValueError, match=r"\.html"):
        sample_report().write(tmp_path / "report.pdf")
    assert list(tmp_path.iterdir()) == []


def test_wrong_use_of_a_section_is_named():
    section = Report("t", {}).section("s")
    with pytest.raises(ValueError, match="speed"):
        section.table([{"a": 1}], "c", sort_by="speed")
    with pytest.raises(ValueError, match="speed"):
        section.table([{"a": 1}], "c", targets={"speed": Target(at_most=1)})
    with pytest.raises(ValueError, match="rows"):
        section.table([], "c")
    with pytest.raises(TypeError, match="list"):
        section.table([{"a": [1]}], "c")
    with pytest.raises(ValueError, match="alt"):
        section.image(np.zeros((2, 2)), "c", " ", "png")
    assert section.blocks == []


@pytest.mark.parametrize(
    "ends", [{}, {"at_most": 1, "at_least": 2}, {"at_most": math.nan}, {"at_least": math.inf}]
)
def test_a_target_that_nothing_could_be_held_against_is_refused(ends):
    with pytest.raises(ValueError, match="target"):
        Target(**ends)


@pytest.mark.parametrize(
    ("value", "met"), [(0.3, True), (0.30001, False), (0, True), (-0.1, False), (None, None), ("x", None)]
)
def test_the_ends_of_a_target_belong_to_it(value, met):
    assert Target(at_least=0, at_most=0.3).met_by(value) is met


def test_a_target_is_written_as_briefly_as_it_was_asked():
    written = [
        str(Target(at_most=0.3)),
        str(Target(at_least=100)),
        str(Target(1e-10)),
        str(Target(1500.0, -2.5)),
    ]
    assert written == ["≤ 0.3", "≥ 100", "≤ 1·10⁻¹⁰", "≥ −2.5, ≤ 1,500"]


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "–"),
        (math.nan, "–"),
        (math.inf, "∞"),
        (-math.inf, "−∞"),
        (True, "yes"),
        (0, "0"),
        (0.0, "0"),
        (-0.0, "0"),
        (1234567, "1,234,567"),
        (-12, "−12"),
        (1 / 3, "0.3333"),
        (-1 / 3, "−0.3333"),
        (13517.28, "13,517"),
        (9.99996, "10.00"),
        (0.00012346, "0.0001235"),
        (1.5e-7, "1.500·10⁻⁷"),
        (-2.5e12, "−2.500·10¹²"),
        (5e-324, "4.941·10⁻³²⁴"),
        (1.7e308, "1.700·10³⁰⁸"),
        ("1-2", "1-2"),
    ],
)
def test_numbers_are_printed_to_four_digits(value, text):
    assert shown(value) == text


WEBM = b"\x1a\x45\xdf\xa3" + bytes(60)


def test_a_video_is_inside_the_page_and_links_lead_to_its_neighbours(tmp_path):
    report = Report("Orbit", {})
    section = report.section("Around the head")
    section.video(WEBM, (96, 144), "Twelve views", "A head that turns")
    section.links([Link("masks", "shards/masks & more.html"), Link("<b>rigs</b>", "rigs")])
    page = Page(report.write(tmp_path / "orbit.html").read_text())
    ((video, _),) = page.all("video")
    assert base64.b64decode(video["src"].removeprefix("data:video/webm;base64,")) == WEBM
    assert video["aria-label"] == "A head that turns"
    found = {text: attrs["href"] for attrs, text in page.all("a")}
    assert found == {"masks": "shards/masks%20%26%20more.html", "<b>rigs</b>": "rigs"}
    twin = read_artifact(tmp_path / "orbit.json", "preface/report")
    assert twin["sections"][0]["blocks"][0]["sha256"] == hashlib.sha256(WEBM).hexdigest()
    assert twin["sections"][0]["blocks"][1]["links"][0] == {
        "text": "masks",
        "path": "shards/masks & more.html",
    }


@pytest.mark.parametrize("path", ["/etc/passwd", "https://example.org", "javascript:alert(1)", "\\\\host\\x"])
def test_a_link_leads_nowhere_but_near_the_page(path):
    with pytest.raises(ValueError, match="not a path from the page's folder"):
        Report("x", {}).section("y").links([Link("z", path)])


def test_what_is_no_video_is_refused():
    section = Report("x", {}).section("y")
    with pytest.raises(ValueError, match="not a WebM file"):
        section.video(b"GIF89a", (1, 1), "caption", "alt")
    with pytest.raises(ValueError, match="alt text"):
        section.video(WEBM, (1, 1), "caption", " ")
