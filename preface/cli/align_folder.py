"""The folder of an alignment between two runs of `preface-align`."""

from pathlib import Path

from preface.align.alignment_files import INDEX_FILE
from preface.artifacts import ArtifactError, load_json, resolve_inside


def forget(folder: Path) -> None:
    """Remove an earlier alignment's index, and its people: some of them may not be in the new one."""
    index = folder / INDEX_FILE
    if not index.is_file():
        return
    earlier = load_json(index).get("aligned", [])
    try:
        index.unlink()
        for entry in earlier:
            resolve_inside(index, "aligned", str(entry["file"])).unlink(missing_ok=True)
    except OSError as error:
        raise ArtifactError.from_os(error.filename or index, "writing", error) from error
    except (TypeError, KeyError) as error:
        problem = "is not the index of an alignment"
        raise ArtifactError(
            index, "aligned", problem, "Choose another --output, or remove the file"
        ) from error
