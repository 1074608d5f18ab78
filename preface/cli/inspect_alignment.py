"""What `preface-inspect` says of alignments: their index, template, people, and landmarks of single views."""

from collections import Counter
from pathlib import Path
from typing import Any

from preface.artifacts import ArtifactError


def summarise_index(path: Path, problems: list[ArtifactError]) -> dict[str, Any]:
    """Read an alignment's index and every file that it names; what is wrong with those joins ``problems``."""
    from preface.align.alignment_files import TEMPLATE_FILE, read_index, read_template
    from preface.align.person_file import read_alignment

    index = read_index(path)
    used: Counter[str] = Counter()
    for entry in index.aligned:
        file = path.parent / entry.file
        used.update(entry.views)
        try:
            person = read_alignment(file)
        except ArtifactError as error:
            problems.append(error)
            continue
        for name, found, expected in (
            ("identity", person.identity, entry.identity),
            ("scheme", person.subject.scheme, index.scheme),
        ):
            if found != expected:
                problem = f"is '{found}', but {path.name} says '{expected}'"
                problems.append(
                    ArtifactError(file, name, problem, "Copy the folder as a whole, or align again")
                )
    try:
        scheme = read_template(path.parent / TEMPLATE_FILE).scheme
        if scheme != index.scheme:
            problem = f"is '{scheme}', but {path.name} says '{index.scheme}'"
            problems.append(ArtifactError(path.parent / TEMPLATE_FILE, "scheme", problem, "Align again"))
    except ArtifactError as error:
        problems.append(error)
    views = [len(entry.views) for entry in index.aligned]
    return {
        "scheme": index.scheme,
        "aligned": [entry.identity for entry in index.aligned],
        "excluded": [f"{entry.identity}: {entry.reason}" for entry in index.excluded],
        "views_used_per_person": sum(views) / len(views) if views else None,
        "views_used_by_camera": [f"{camera} {count}" for camera, count in sorted(used.items())],
        "flagged": [f"{entry.identity}: {', '.join(entry.flags)}" for entry in index.aligned if entry.flags],
        "warnings": list(index.warnings),
    }


def summarise_template(path: Path) -> dict[str, Any]:
    """Read a template."""
    from preface.align.alignment_files import read_template
    from preface.align.keypoints import CANONICAL_KEYPOINTS

    template = read_template(path)
    return {
        "scheme": template.scheme,
        "identities": len(template.identities),
        "procrustes": template.procrustes,
        "eye_distance_m": template.eye_distance,
        "keypoints_m": [
            {"name": name, "at": point.tolist(), "spread": float(spread)}
            for name, point, spread in zip(
                CANONICAL_KEYPOINTS, template.keypoints, template.spread, strict=True
            )
        ],
    }


def summarise_person(path: Path) -> dict[str, Any]:
    """Read one person's alignment."""
    from preface.align.keypoints import CANONICAL_KEYPOINTS
    from preface.align.person_file import read_alignment

    person = read_alignment(path)
    subject, place = person.subject, person.placement
    keypoints = subject.keypoints
    rows = zip(CANONICAL_KEYPOINTS, keypoints.positions, keypoints.views, keypoints.reasons, strict=True)
    return {
        "identity": person.identity,
        "take": person.take,
        "scheme": subject.scheme,
        "views_used": len(subject.cameras),
        "views_left_out": [
            f"{camera}: {verdict.code}" for camera, verdict in subject.views.items() if not verdict.used
        ],
        "landmarks": int(subject.landmarks.ok.sum()),
        "keypoints_m": [
            {"name": name, "missing": reason}
            if reason
            else {"name": name, "at": at.tolist(), "views": int(views)}
            for name, at, views, reason in rows
        ],
        "eye_distance_m": keypoints.eye_distance,
        "scale": float(place.canonical_from_rig.scale),
        "flags": [flag.text for flag in place.flags],
    }


def summarise_landmarks(path: Path) -> dict[str, Any]:
    """Read the landmarks of one view."""
    import numpy as np

    from preface.align.landmark_files import read_landmarks
    from preface.align.landmarks import NoFace
    from preface.artifacts import load_json

    found = read_landmarks(path, None, None)
    content = load_json(path)
    summary: dict[str, Any] = {
        "subject": content["subject"],
        "camera": content["camera"],
        "size": f"{content['width']}x{content['height']}",
    }
    if isinstance(found, NoFace):
        return {**summary, "no_face": found.reason}
    return {
        **summary,
        "scheme": found.scheme,
        "landmarks": int(found.seen.sum()),
        "median_sigma_px": float(np.median(found.sigma[found.seen])),
        "median_confidence": float(np.median(found.confidence[found.seen])),
        "rotation_degrees": found.rotation,
        "other_faces": found.others,
        "warnings": list(found.warnings),
    }
