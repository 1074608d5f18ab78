"""What `preface-inspect` says of a prior, or of a head that was fitted from one."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from preface.artifacts import ArtifactError


def summarise_prior(path: Path, problems: list[ArtifactError]) -> dict[str, Any]:
    """Read ``model.json`` and check the tensors that it describes; what is wrong with those joins ``problems``."""
    from preface.model.training.checkpoint import STATE, read_tensors
    from preface.model.training.prior_files import read_prior

    prior = read_prior(path)
    parameters = None
    try:
        parameters = sum(p.numel() for p in prior.load_model().parameters())
        if STATE in prior.files:
            read_tensors(prior.path, {"files": prior.files}, STATE)
    except ArtifactError as error:
        problems.append(error)
    model, scene = prior.model, prior.scene
    return {
        "steps": f"{prior.step} of {prior.steps}{'' if prior.finished else ', not finished'}",
        "identities": list(prior.identities),
        "parameters": parameters,
        "latent": model.latent,
        "networks": f"proposal {model.proposal.depth}x{model.proposal.width}, "
        f"NeRF {model.nerf.depth}x{model.nerf.width}",
        "samples": list(model.samples),
        "encoding_levels": model.levels,
        "background": model.background,
        "resolution": f"{scene.resolution[0]}x{scene.resolution[1]}",
        "box_m": scene.box.reshape(-1).tolist(),
        "held_out_views": sum(len(views) for views in prior.held_out.values()),
        "validation": [f"{name} {value:.6g}" for name, value in prior.validation.items()],
        "can_resume": STATE in prior.files,
        **({} if prior.fit is None else _summarise_fit(prior.fit)),
    }


def _summarise_fit(fit: Mapping[str, Any]) -> dict[str, Any]:
    """What a head was fitted to, and how."""
    size, loss, refined = fit["resolution"], fit["inversion"]["loss"], fit.get("refinement")
    moved = {
        name: f"{np.degrees(np.linalg.norm(correction['rotation'])):.2f} degrees, "
        f"{1e3 * np.linalg.norm(correction['translation_m']):.1f} mm"
        for name, correction in fit["cameras"].items()
    }
    return {
        "head_of": fit["identity"],
        "fitted_to": [
            f"{view} (camera moved by {moved[view]})" if view in moved else view for view in fit["views"]
        ],
        "fitted_at": f"{size['width']}x{size['height']}",
        "from": "random weights"
        if fit["prior"] is None
        else f"the prior with model.json {fit['prior'][:12]}...",
        "inversion": f"{fit['inversion']['steps']} steps" + ("" if loss is None else f", loss {loss:.4g}"),
        **({} if refined is None else {"corrections_of_cameras": _judged(refined)}),
        "finetuning": f"{fit['finetuning']['steps']} steps",
        "quality": fit["quality"],
    }


def _judged(refined: Mapping[str, Any]) -> str:
    return f"{'kept' if refined['kept'] else 'not kept'}, views met {refined['gain_db']:+.2f} dB better with them"
