"""Who may import whom, and what a command may load before it has read its arguments.

The table is that of CONTRIBUTING: each part of the package with what it may know. Imports are read from the
source, those inside functions too; what an import at run time pulls in is followed through the whole package.
"""

import ast
import functools
import json
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
BASE = {"plain_words", "progress", "artifacts", "srgb"}
MAY_IMPORT = {
    "plain_words": set(),
    "progress": {"plain_words"},
    "geometry": set(),
    "srgb": set(),
    "artifacts": {"plain_words"},
    "reports": BASE,
    "capture": {*BASE, "geometry", "reports"},
    "align": {*BASE, "geometry", "reports", "capture"},
    "shards": {*BASE, "geometry", "reports", "capture", "align"},
    # Not capture and align: how shards were made is not a model's business.
    "model": {*BASE, "geometry", "reports", "shards"},
    "cli": {*BASE, "geometry", "reports", "capture", "align", "shards", "model"},
}
# The parts of preface.shards that make datasets or carry them elsewhere; the rest reads and writes the format.
PIPELINE = ("preface.shards.dataset", "preface.shards.export")
# Nothing of this is needed to print a help, and each costs from a tenth of a second to several.
HEAVY = (
    *("torch", "cv2", "mediapipe", "open3d", "pycolmap", "scipy", "matplotlib", "numba", "onnxruntime"),
    *("trimesh", "distributed", "anny", "numpy", "jsonschema", "typeguard"),
)
SCRIPTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


SOURCES = {module_name(path): path.read_text() for path in sorted((ROOT / "preface").rglob("*.py"))}
PARTS = sorted(set(SOURCES) - {"preface"})


def for_types_only(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)


@functools.cache
def imports(source: str, at_import_time: bool) -> frozenset[str]:
    """Modules of this package that a source imports; `from a import b` means a.b where that is a module."""
    found: set[str] = set()

    def visit(node: ast.AST) -> None:
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute here"
            found.update({f"{node.module}.{a.name}" for a in node.names} & set(SOURCES) or {str(node.module)})
        for child in ast.iter_child_nodes(node):
            later = isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef) or for_types_only(child)
            # Expressions hold no imports.
            if not isinstance(child, ast.expr) and not (at_import_time and later):
                visit(child)

    visit(ast.parse(source))
    return frozenset(name for name in found if name.startswith("preface."))


def part(module: str) -> str:
    return f"{module}.".split(".")[1]


def violations(sources: dict[str, str]) -> Iterator[str]:
    """Imports that the table does not allow, as "module imports module"."""
    for module, source in sources.items():
        allowed = MAY_IMPORT.get(part(module), set()) | {part(module)}
        for name in sorted(imports(source, at_import_time=False)):
            forbidden = part(name) not in allowed
            # The model reads shards and writes those of a head; it does not know the pipeline.
            if forbidden or (part(module) == "model" and name.startswith(PIPELINE)):
                yield f"{module} imports {name}"


def loaded_with(module: str) -> set[str]:
    """Modules of this package that importing one loads."""
    seen: set[str] = set()
    left = [module]
    while left:
        name = left.pop()
        if name in SOURCES and name not in seen:
            seen.add(name)
            left += imports(SOURCES[name], at_import_time=True)
            left.append(name.rpartition(".")[0])
    return seen


def test_every_part_of_the_package_has_its_place_in_the_table():
    assert {part(name) for name in PARTS} == set(MAY_IMPORT)


def test_no_module_imports_from_below_its_layer():
    assert list(violations({name: SOURCES[name] for name in PARTS})) == []


@pytest.mark.parametrize(
    ("module", "source", "expected"),
    [
        ("preface.model.rays", "def f():\n    from preface.capture import rig", ["preface.capture.rig"]),
        ("preface.model.rays", "import preface.align.report", ["preface.align.report"]),
        ("preface.model.rays", "from preface.shards.dataset.plan import x", ["preface.shards.dataset.plan"]),
        ("preface.shards.reader", "from preface.cli.output import say", ["preface.cli.output"]),
        ("preface.geometry.boxes", "from preface import artifacts", ["preface.artifacts"]),
        ("preface.capture.rig", "if TYPE_CHECKING:\n    import preface.align", ["preface.align"]),
        ("preface.model.rays", "from preface.shards.writer import Head", []),
        ("preface.cli.fit", "from preface.model.model import PriorModel", []),
    ],
)
def test_the_rule_sees_imports_wherever_they_stand(module, source, expected):
    found = list(violations({module: source}))
    assert found == [f"{module} imports {name}" for name in expected]


def test_the_format_of_shards_loads_nothing_of_the_pipeline_that_makes_them():
    readers = [n for n in PARTS if n.startswith("preface.shards") and not n.startswith(PIPELINE)]
    assert "preface.shards.writer" in readers
    for module in readers:
        pulled = {name for name in loaded_with(module) if part(name) in ("capture", "align")}
        assert pulled == set(), module


def test_what_importing_loads_is_followed_through_other_modules():
    assert "preface.capture.images" in loaded_with("preface.shards.dataset.heads")
    assert "preface.capture" not in loaded_with("preface.shards")
    assert {"preface.artifacts", "preface.plain_words"} <= loaded_with("preface.shards.writer")


@pytest.fixture(scope="module")
def helps() -> dict[str, dict]:
    """What each command's help prints, its exit status, and what of HEAVY it was first to load; one process."""
    program = (
        "import contextlib, importlib, io, json, sys\n"
        f"scripts, heavy, before, found = {SCRIPTS!r}, {HEAVY!r}, set(), {{}}\n"
        "for name, target in scripts.items():\n"
        "    module, function = target.split(':')\n"
        "    out, status = io.StringIO(), 'returned'\n"
        "    with contextlib.redirect_stdout(out):\n"
        "        try:\n"
        "            getattr(importlib.import_module(module), function)(['--help'])\n"
        "        except SystemExit as ended:\n"
        "            status = ended.code\n"
        "    loaded = {h for h in heavy if h in sys.modules}\n"
        "    found[name] = {'out': out.getvalue(), 'status': status, 'heavy': sorted(loaded - before)}\n"
        "    before |= loaded\n"
        "print(json.dumps(found))\n"
    )
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)


@pytest.mark.parametrize("script", SCRIPTS)
def test_the_help_of_every_command_works_and_waits_for_nothing_heavy(script, helps):
    assert helps[script]["status"] == 0
    assert helps[script]["out"].startswith(f"usage: {script} ")
    assert helps[script]["heavy"] == []
