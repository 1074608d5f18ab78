"""Wrong usage of the tools is told in one line, as that of the commands."""

import importlib
import sys
from pathlib import Path

import pytest

TOOLS = Path(__file__).resolve().parents[2] / "tools"
if str(TOOLS) not in sys.path:
    sys.path.insert(0, str(TOOLS))


@pytest.mark.parametrize(
    ("tool", "arguments", "line"),
    [
        (
            "ablate",
            ["shards"],
            "ablate.py: error: the following arguments are required: --prior, --output; see",
        ),
        ("measure_tradeoff", ["fit"], " fit: error: the following arguments are required: "),
        (
            "speed_for_accuracy",
            ["keep", "nothing", "x", "--of", "y"],
            "argument source: invalid choice: 'nothing'",
        ),
    ],
)
def test_wrong_usage_is_one_line_that_says_where_flags_are_explained(tool, arguments, line, capsys):
    with pytest.raises(SystemExit, match="2"):
        importlib.import_module(tool).main(arguments)
    (told,) = capsys.readouterr().err.splitlines()
    assert line in told
    assert told.endswith("--help")


def test_all_tools_say_it_so():
    """But for the example of another trainer, which is to need nothing of this project except the reader."""
    sources = {path.name: path.read_text(encoding="utf-8") for path in TOOLS.rglob("*.py")}
    assert {name for name, text in sources.items() if "ArgumentParser(" in text} == {"train_elsewhere.py"}
    assert not {n for n, text in sources.items() if "tyro.cli(" in text and "told_in_a_line(" not in text}
