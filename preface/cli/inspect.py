"""``preface-inspect``: validate artefacts, summarise them, and say what is wrong with them."""

import json
import sys
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from preface.artifacts import ArtifactError, load_json, read_artifact
from preface.cli.inspect_exports import RAYS, TRANSFORMS
from preface.cli.inspect_folders import artifacts_at
from preface.cli.output import interruptible, print_lines, say
from preface.cli.usage import Parser
from preface.model.pretrained import prior_flag, prior_path
from preface.plain_words import shown, suggestion

if TYPE_CHECKING:  # these need numpy; --help must not wait for it
    from preface.capture.images import ImageHeader
    from preface.capture.manifest import Capture

_DESCRIPTION = (
    "Validate captures, rigs, alignments, shards, priors, heads, figures and reports, print what they hold, "
    "and say what is wrong with them."
)
_EPILOG = "Exit status: 0 when all is well, 1 when something is wrong, 2 for wrong usage."
_PATH_HELP = (
    "an artefact, or a folder of a capture, a rig, an alignment, shards, a prior, a head or its figures, an evaluation "
    "or an export; `pretrained` is the prior that comes with preface"
)
MAX_LISTED = 20  # problems and missing views beyond this are counted; --json lists them all


@dataclass
class Report:
    """What one artefact holds and what is wrong with it.

    Attributes:
        path: the artefact.
        schema: its schema, None when that could not be determined.
        summary: what it holds, JSON types, for people and programs.
        problems: everything wrong that was found.
    """

    path: Path
    schema: str | None = None
    summary: dict[str, Any] = field(default_factory=dict)
    problems: list[ArtifactError] = field(default_factory=list)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status."""
    parser = Parser("preface-inspect", description=_DESCRIPTION, epilog=_EPILOG)
    parser.add_argument("paths", metavar="PATH", nargs="+", type=prior_flag, help=_PATH_HELP)
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of text")
    config = parser.parse_args(arguments)
    return interruptible(lambda: _told(config.paths, as_json=config.json))


def _told(paths: Sequence[str | Path], *, as_json: bool) -> int:
    """Inspect artefacts and print what was found; 1 if anything is wrong."""
    reports = [report for path in paths for report in inspect(path)]
    problems = [problem for report in reports for problem in report.problems]
    if print_lines([_as_json(reports) if as_json else _as_text(reports)]) != 0:
        return 1
    if not as_json:
        for problem in problems[:MAX_LISTED]:
            say(str(problem))
        if len(problems) > MAX_LISTED:
            say(f"... and {len(problems) - MAX_LISTED} more problems; --json lists all")
    return 1 if problems else 0


def inspect(path: str | Path) -> list[Report]:
    """Inspect one artefact, or all those of a folder; the text `pretrained` is the prior that comes with preface."""
    try:
        return [_inspect_artifact(Report(*found)) for found in artifacts_at(prior_path(path))]
    except ArtifactError as error:
        return [Report(Path(path), problems=[error])]
    except OSError as error:
        return [Report(Path(path), problems=[ArtifactError.from_os(path, "file", error)])]


def _inspect_artifact(report: Report) -> Report:
    summarise: Mapping[str, Callable[[Report], None]] = {
        "preface/capture": _summarise_capture,
        "preface/corners": _summarise_corners,
        "preface/rig": _summarise_rig,
        "preface/alignment-index": _summarise_alignment,
        "preface/template": _summarise_alignment,
        "preface/alignment": _summarise_alignment,
        "preface/landmarks": _summarise_alignment,
        "preface/report": _summarise_report,
        "preface/prior": _summarise_prior,
        "preface/metrics": _summarise_metrics,
        "preface/shards": _summarise_shards,
        "preface/shard": _summarise_shards,
        RAYS: _summarise_export,
        TRANSFORMS: _summarise_export,
    }
    try:
        if report.schema is None:
            declared = load_json(report.path).get("schema")
            if not isinstance(declared, str) or declared not in summarise:
                problem = f"{shown(declared)} is not a kind of artefact that preface knows"
                raise ArtifactError(report.path, "schema", problem, suggestion(declared, summarise))
            report.schema = declared
        summarise[report.schema](report)
    except ArtifactError as error:
        report.problems.append(error)
    return report


# ---------------------------------------------------------------------------------------- captures


def _summarise_capture(report: Report) -> None:
    from preface.capture.manifest import read_capture

    capture = read_capture(report.path)
    manifest = capture.manifest
    headers = _check_images(capture, report.problems)
    formats = Counter(f"{h.width}x{h.height} {h.format}, {h.channels} channels" for h in headers)
    report.summary = {
        "manifest": "inferred from the layout" if capture.inferred else "capture.json",
        "cameras": [camera.id for camera in manifest.cameras],
        "boards": [
            f"{b.id}: {b.type} {b.squares[0]}x{b.squares[1]}, {b.square_size} m" for b in manifest.boards
        ],
        "takes": [
            {
                "id": take.id,
                "background": take.background,
                "board": board.id if (board := manifest.board_of(take)) else None,
                "calibration_files": sum(
                    len(capture.calibration_files(take, c.id)) for c in manifest.cameras
                ),
                "plates": sum((take.id, camera.id) in capture.plates for camera in manifest.cameras),
            }
            for take in manifest.takes
        ],
        "subjects": [subject.id for subject in manifest.subjects],
        "images": len(capture.images),
        "masks": len(capture.masks),
        "formats": [f"{count} x {kind}" for kind, count in sorted(formats.items())],
        "missing_views": [f"{subject}/{camera}" for subject, camera in capture.missing_views],
    }


def _check_images(capture: "Capture", problems: list[ArtifactError]) -> list["ImageHeader"]:
    """Read the header of every image, mask and plate; all of one camera must have one size."""
    from preface.capture.images import ImageError, read_header

    sizes = {c.id: (c.width, c.height, "capture.json") for c in capture.manifest.cameras if c.width}
    image_headers = []
    for files in (capture.images, capture.masks, capture.plates):
        for (_, camera), file in files.items():
            try:
                header = read_header(file)
            except ArtifactError as error:
                problems.append(error)
                continue
            if files is capture.images:
                image_headers.append(header)
            width, height, source = sizes.setdefault(camera, (header.width, header.height, str(file)))
            if (header.width, header.height) != (width, height):
                problem = (
                    f"is {header.width}x{header.height}, but {source} says {width}x{height} for '{camera}'"
                )
                remedy = "All images of a camera have one size: correct the image or the manifest"
                problems.append(ImageError(file, "size", problem, remedy))
    return image_headers


# -------------------------------------------------------------------------------------------- rigs


def _summarise_rig(report: Report) -> None:
    from preface.capture.rig import read_rig

    rig = read_rig(report.path)
    held_out = rig.held_out_reprojection_error
    report.summary = {
        "take": rig.take,
        "cameras": [
            {
                "id": name,
                "size": f"{entry.camera.width}x{entry.camera.height}",
                "model": entry.camera.model,
                "focal_length_px": float(entry.camera.intrinsics[0]),
                "center_m": entry.camera_from_rig.inverse.translation.tolist(),
                "reprojection_rms_px": entry.reprojection_error.rms if entry.reprojection_error else None,
            }
            for name, entry in rig.cameras.items()
        ],
        "held_out_reprojection_rms_px": held_out.rms if held_out else None,
    }


# ----------------------------------------------------------------------------------------- corners


def _summarise_corners(report: Report) -> None:
    from preface.capture.boards import board_in_words
    from preface.capture.corners import read_corners

    corners = read_corners(report.path)
    seen = corners.observations
    report.summary = {
        "take": corners.take,
        "board": board_in_words(corners.board) if corners.board else None,
        "board_points": len(seen.board_points),
        "frames": len(seen.frame_ids),
        "corners": len(seen),
        "cameras": [
            {
                "id": name,
                "size": f"{size[0]}x{size[1]}",
                "frames": int((row > 0).sum()),
                "corners": int(row.sum()),
            }
            for name, size, row in zip(seen.camera_ids, seen.image_sizes, seen.counts, strict=True)
        ],
        "warnings": list(corners.warnings),
    }


# -------------------------------------------------------------------------------------- alignments


def _summarise_alignment(report: Report) -> None:
    from preface.cli import inspect_alignment

    match report.schema:
        case "preface/alignment-index":
            report.summary = inspect_alignment.summarise_index(report.path, report.problems)
        case "preface/template":
            report.summary = inspect_alignment.summarise_template(report.path)
        case "preface/alignment":
            report.summary = inspect_alignment.summarise_person(report.path)
        case "preface/landmarks":
            report.summary = inspect_alignment.summarise_landmarks(report.path)


# ----------------------------------------------------------------------------------------- reports


def _summarise_report(report: Report) -> None:
    content = read_artifact(report.path, "preface/report")
    report.summary = {
        "title": content["title"],
        "sections": [section["heading"] for section in content["sections"]],
    }


# ------------------------------------------------------------------------------------------ shards


def _summarise_prior(report: Report) -> None:
    from preface.cli import inspect_prior

    report.summary = inspect_prior.summarise_prior(report.path, report.problems)


def _summarise_metrics(report: Report) -> None:
    from preface.cli import inspect_metrics

    report.summary = inspect_metrics.summarise_metrics(report.path)


def _summarise_shards(report: Report) -> None:
    from preface.cli import inspect_shards

    summarise = (
        inspect_shards.summarise_shard
        if report.schema == "preface/shard"
        else inspect_shards.summarise_dataset
    )
    report.summary = summarise(report.path, report.problems)


# ----------------------------------------------------------------------------------------- exports


def _summarise_export(report: Report) -> None:
    from preface.cli import inspect_exports

    if report.schema == RAYS:
        report.summary = inspect_exports.summarise_rays(report.path)
    else:
        report.summary = inspect_exports.summarise_transforms(report.path, report.problems)


# ------------------------------------------------------------------------------------------ output


def _as_json(reports: list[Report]) -> str:
    artifacts = [
        {
            "path": str(report.path),
            "schema": report.schema,
            "ok": not report.problems,
            "problems": [
                {"file": str(p.path), "field": p.field, "problem": p.problem, "remedy": p.remedy}
                for p in report.problems
            ],
            "summary": report.summary,
        }
        for report in reports
    ]
    return json.dumps({"ok": all(a["ok"] for a in artifacts), "artifacts": artifacts}, indent=2)


def _as_text(reports: list[Report]) -> str:
    lines = []
    for report in reports:
        count = len(report.problems)
        verdict = "valid" if not count else f"{count} problem{'s' if count > 1 else ''}"
        lines.append(f"{report.path}: {report.schema or 'unknown kind'}: {verdict}")
        lines += [f"  {key.replace('_', ' '):<30}{_cell(value)}" for key, value in report.summary.items()]
    return "\n".join(lines)


def _cell(value: Any) -> str:
    """One line for a name or number; for a list its length and then its entries."""
    if value is None:
        return "-"
    if isinstance(value, dict):
        return ", ".join(f"{key.replace('_', ' ')} {_cell(item)}" for key, item in value.items())
    if not isinstance(value, list):
        return f"{value:.6g}" if isinstance(value, float) else str(value)
    if not value:
        return "none"
    if all(isinstance(item, float) for item in value):
        return "(" + ", ".join(f"{item:.4f}" for item in value) + ")"
    rest = f", ... and {len(value) - MAX_LISTED} more" if len(value) > MAX_LISTED else ""
    if isinstance(value[0], dict):
        return str(len(value)) + "".join(f"\n    {_cell(item)}" for item in value)
    return f"{len(value)}: " + ", ".join(map(str, value[:MAX_LISTED])) + rest


if __name__ == "__main__":
    sys.exit(main())
