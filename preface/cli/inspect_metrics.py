"""What `preface-inspect` says of the figures of a head."""

from pathlib import Path
from typing import Any

from preface.model.evaluation.metrics_file import read_metrics


def summarise_metrics(path: Path) -> dict[str, Any]:
    """Read ``metrics.json``; returns what it holds.

    Raises:
        ArtifactError: it is none, or its means are not those of its views.
    """
    content = read_metrics(path)
    views, size = content["views"], content["resolution"]
    worst = min(views, key=lambda view: view["psnr"])
    missing = {
        f"{view['name']}/{figure}: {why}" for view in views for figure, why in view["left_out"].items()
    }
    return {
        "head": content["name"],
        "kind": content["kind"],
        "identity": content["identity"],
        "resolution": f"{size['width']}x{size['height']}",
        "views": [view["name"] for view in views],
        "views_that_were_fitted_to": sum(view["fitted"] for view in views),
        "mean": [f"{name} {value:.6g}" for name, value in content["mean"].items()],
        "worst_view": f"{worst['name']}, psnr {worst['psnr']:.6g}",
        "left_out": sorted(missing),
    }
