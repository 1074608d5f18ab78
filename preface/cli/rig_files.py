"""Rigs on the disk as commands name them: which files a path means, and where a new rig and its report go."""

from pathlib import Path

from preface.artifacts import ArtifactError, load_json
from preface.capture.rig import SCHEMA
from preface.cli.usage import UsageError

RIG_FILE = "rig.json"
MAX_NAMED = 8  # rigs in an error


def rig_files(path: Path) -> list[Path]:
    """The rigs at a path: a file, or those in a folder, in its folder `rigs`, or in its takes' folders.

    Raises:
        ArtifactError: a folder without any.
    """
    if not path.is_dir():
        return [path]
    candidates = [*path.glob("*.json"), *path.glob("rigs/*.json"), *path.glob(f"*/{RIG_FILE}")]
    found = sorted(file for file in candidates if load_json(file).get("schema") == SCHEMA)
    if not found:
        problem = f"holds no rig, neither as *.json nor as rigs/*.json nor as */{RIG_FILE}"
        raise ArtifactError(path, "folder", problem, "Name the rig, as preface-calibrate wrote it")
    return found


def one_rig_file(path: Path) -> Path:
    """The rig at a path where one is wanted: its only one, or its rig.json.

    Raises:
        ArtifactError: a folder without any, or with several.
    """
    if (path / RIG_FILE).exists():
        return path / RIG_FILE
    found = rig_files(path)
    if len(found) > 1:
        names = ", ".join(str(file.relative_to(path)) for file in found[:MAX_NAMED])
        names += ", ..." if len(found) > MAX_NAMED else ""
        raise ArtifactError(path, "folder", f"holds several rigs: {names}", f"Name one, such as {found[0]}")
    return found[0]


def new_rig_file(output: Path) -> Path:
    """The file that ``--output`` means: itself, or rig.json in what is a folder, or looks like one."""
    return output / RIG_FILE if output.is_dir() or not output.suffix else output


def new_report_file(given: Path | None, rig: Path) -> Path:
    """The page that ``--report`` means, by default beside the rig.

    Raises:
        UsageError: it does not end in .html.
    """
    if given is not None and given.suffix != ".html":
        raise UsageError(f"--report: {given} does not end in .html")
    return given or rig.with_suffix(".report.html")
