"""Tables of heads side by side, read back cell by cell."""

import re

import pytest

from preface.model.evaluation.tables import latex, markdown

ROWS = [
    {"name": "with|prior", "identity": "id0", "fitted": 2, "views": 9, "psnr": 25.004, "lpips": 0.2},
    {"name": "none_100%", "identity": "id0", "fitted": 2, "views": 9, "psnr": 24.0, "lpips": 0.1},
    {"name": "other", "identity": "id1", "fitted": 3, "views": 8, "psnr": 21.0, "ssim": 0.75},
]


def cells(line: str) -> list[str]:
    return [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]


def test_markdown_has_a_row_per_head_with_the_best_of_an_identity_in_bold():
    heading, rule, *rows = [cells(line) for line in markdown(ROWS).splitlines()]
    assert heading == [
        "head",
        "identity",
        "fitted to",
        "views",
        "frame PSNR ↑",
        "frame SSIM ↑",
        "frame LPIPS ↓",
    ]
    assert set(rule) == {"---", "---:"}
    assert rows == [
        ["with\\|prior", "id0", "2", "9", "**25.00**", "–", "0.2000"],
        ["none_100%", "id0", "2", "9", "24.00", "–", "**0.1000**"],
        ["other", "id1", "3", "8", "21.00", "0.7500", "–"],
    ]


def test_nothing_is_best_among_equals_as_printed_or_alone():
    twins = [ROWS[0], ROWS[0] | {"name": "again", "psnr": 25.0041}]
    assert "**" not in markdown(twins)
    assert "**" not in markdown(ROWS[:1])


def test_heads_that_were_evaluated_at_other_numbers_of_views_do_not_compete():
    assert "**" not in markdown([ROWS[0], ROWS[1] | {"views": 8}])


def test_latex_has_as_many_cells_in_every_row_as_columns_and_escapes_names():
    lines = latex(ROWS).splitlines()
    columns = re.fullmatch(r"\\begin\{tabular\}\{([lr]+)\}", lines[0])[1]
    rows = [line.removesuffix(r" \\").split(" & ") for line in lines if line.endswith(r" \\")][1:]
    assert {len(row) for row in rows} == {len(columns)} == {7}
    assert rows[1][-3:] == [r"\textbf{25.00}", "--", "0.2000"]
    assert rows[2][0] == r"none\_100\%"
    assert r"\multicolumn{3}{c}{frame}" in latex(ROWS)
    assert lines[-1] == r"\end{tabular}"


@pytest.mark.parametrize("table", [markdown, latex])
def test_no_rows_are_no_table(table):
    with pytest.raises(ValueError, match="rows"):
        table([])
