"""What no parser knows of a command: what it reads and writes, and how it is called, for `command_pages`.

In the order of the main job. A test has every example read by the command that it calls.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Tour:
    """A command's input, output and examples; the first two are Markdown."""

    reads: str
    writes: str
    examples: tuple[str, ...]


def _spec(words: str, page: str) -> str:
    return f"[{words}](../../data_specs/{page}.md)"


_CAPTURE = f"a {_spec('capture', 'capture')}"
_RIG = f"a {_spec('rig', 'rig')}"
_SHARDS = _spec("shards", "shards")
_REPORT = f"a page for a browser with its {_spec('twin', 'report')} in JSON"
_PRIOR = _spec("model.safetensors, model.json and training_state.safetensors", "prior")

TOURS = {
    "preface-calibrate": Tour(
        f"{_CAPTURE} with frames of a board, photographs of one person, or a rig of another program",
        f"{_RIG}, the {_spec('corners', 'corners')} that were found, and {_REPORT}",
        (
            "preface-calibrate board charuco4 --board charuco --squares 4x5 --square-size 0.054 --marker-size 0.0405 "
            "--dictionary DICT_4X4_1000 --inverted --output rig.json",
            "preface-calibrate board studio3 --board chessboard --squares 9x6 --square-size 0.010 --output rig.json",
            "preface-calibrate board studio/capture --output studio",
            "preface-calibrate photos pictures --output rig.json",
            "preface-calibrate import sparse/0 --scale arbitrary --output rig.json",
            "preface-calibrate export rig.json --format nerfstudio --output transforms.json",
        ),
    ),
    "preface-align": Tour(
        f"{_CAPTURE} and its {_spec('rigs', 'rig')}, or a folder of one to seven photographs; "
        f"{_spec('landmarks', 'landmarks')} and a {_spec('template', 'template')}, where they are given",
        f"the {_spec('landmarks', 'landmarks')} of each photograph, a {_spec('template', 'template')}, "
        f"{_spec('<identity>.json', 'alignment').replace('<', chr(92) + '<')} for each person, "
        f"the {_spec('index', 'alignment-index')} alignment.json, and {_REPORT}; from photographs also {_RIG}",
        (
            "preface-align studio studio/capture --rig studio --output alignment",
            "preface-align studio studio3 --rig rig.json --output alignment",
            "preface-align studio new/capture --rig new --template alignment --output new/alignment",
            "preface-align photos pictures --output person",
        ),
    ),
    "preface-build-shards": Tour(
        f"{_CAPTURE}, its {_spec('rigs', 'rig')} and an {_spec('alignment', 'alignment-index')}; `export` {_SHARDS}; "
        "`import` a public dataset",
        f"{_SHARDS} with a data card, and a page of the masks; `export` {_spec('rays', 'rays')} or a "
        f"{_spec('folder for nerfstudio', 'transforms')} per identity; `import` {_CAPTURE} with rigs",
        (
            "preface-build-shards studio/capture --rig studio --alignment alignment --output shards "
            "--resolution 256x384 --holdout 10%",
            "preface-build-shards pictures --rig person --alignment person --output shards --resolution 270x480 "
            "--masks matte",
            "preface-build-shards studio/capture --rig studio --alignment alignment --resolution 256x384 --dry-run",
            "preface-build-shards export shards --format rays --identities NAME --output rays",
            "preface-build-shards import DATA --layout cafca --output capture",
        ),
    ),
    "preface-train": Tour(
        _SHARDS,
        f"{_PRIOR}, {_spec('log.jsonl', 'log')}, events for TensorBoard, and pictures of views that are kept away",
        (
            "preface-train shards --preset small --output prior",
            "preface-train shards --preset studio --device cuda --micro-rays 4096 --output prior",
        ),
    ),
    "preface-fit": Tour(
        f"{_SHARDS}, or a folder of one to seven photographs; a {_spec('prior', 'prior')}",
        f"a head: {_PRIOR}, {_spec('log.jsonl', 'log')}, events for TensorBoard, and pictures; from photographs also "
        f"{_RIG}, an {_spec('alignment', 'alignment-index')}, {_SHARDS}, and {_REPORT} that says how far the result "
        "can be trusted",
        (
            "preface-fit shards --prior prior --identity NAME --views cam04 cam05 --output head",
            "preface-fit pictures --output head",
            "preface-fit shards --prior none --like prior --identity NAME --views cam04 cam05 --output alone",
        ),
    ),
    "preface-render": Tour(
        f"a {_spec('prior or a head', 'prior')}; {_RIG} and an {_spec('alignment', 'alignment')}, where they are given",
        "colour, opacity, depth and normals as PNG and EXR, a legend of what the colours mean, the "
        f"{_spec('cameras', 'rig')}, a video, a mesh",
        (
            "preface-render head --orbit 48 --video --output renders",
            "preface-render head --size 4096x4096 --mesh head.glb --output large",
            "preface-render prior --identity NAME --towards OTHER --orbit 9 --azimuth 0 --elevation 0 --output between",
            "preface-render prior --identity NAME --cameras rig.json --alignment alignment/NAME.json --output renders",
        ),
    ),
    "preface-evaluate": Tour(
        f"{_spec('heads', 'prior')} and the {_SHARDS} with the photographs",
        f"{_spec('metrics.json', 'metrics')} for each head, pictures, tables in Markdown and LaTeX, and {_REPORT}",
        (
            "preface-evaluate head alone --shards shards --output evaluation",
            "preface-evaluate prior --shards shards --identity NAME --output evaluation",
        ),
    ),
    "preface-inspect": Tour(
        "any of the [artefacts](../../data_specs/README.md), or a folder of them",
        "nothing; it prints",
        ("preface-inspect studio/capture", "preface-inspect --json shards prior"),
    ),
}
