"""What an evaluation can be asked to do differently, as plain data; nothing here imports torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

LpipsChoice = Literal["both", "vgg", "alex", "none"]
LPIPS_CHOICES: tuple[LpipsChoice, ...] = ("both", "vgg", "alex", "none")
# From above the hairline to below the chin and from ear to ear: 0.12 m about the mean of outer eye corners, nose,
# mouth and chin. The paper crops "to squares" and "to the face region" without a figure.
FACE_HALF_SIDE = 0.12


@dataclass(frozen=True)
class EvaluationOptions:
    """How heads are rendered and measured."""

    lpips: LpipsChoice = "both"
    """Networks of LPIPS. VGG, called `lpips`, is what radiance fields are mostly compared with and what inversion
    descends on; AlexNet, `lpips_alex`, is the default of LPIPS' authors and by default no part of a loss here. The
    paper does not say which it means, hence both."""
    face_half_side: float = FACE_HALF_SIDE
    """Half the side of the face crop, metres at the canonical origin."""
    quality: str = "reference"
    """Shortcuts of rendering, by name (`preface.model.rendering.shortcuts`); `reference` has none, so that figures are
    those of the model as trained. Its proposals learn from the views fitted to alone: after 3,000 steps of finetuning
    two views, `balanced`, which finds surfaces in the density, was 1.1 dB better at other views."""
    normals: bool = True
    """Also find normals, to be shown. They take the density's derivative, and no figure depends on them."""
    rays_at_a_time: int = 4096
    """Rays that are rendered together; memory goes with it."""
    device: str = "cpu"
    """cpu, cuda or cuda:N."""

    @property
    def networks(self) -> dict[str, Literal["vgg", "alex"]]:
        """The figures that LPIPS gives, and the network of each."""
        figures: dict[str, Literal["vgg", "alex"]] = {"lpips": "vgg", "lpips_alex": "alex"}
        return {name: network for name, network in figures.items() if self.lpips in ("both", network)}

    def settings(self) -> dict[str, Any]:
        """What decides the figures, as metrics.json has it."""
        return {
            "background": "black",
            "quality": self.quality,
            "mask": "the photograph times its foreground, sRGB-encoded; the render as it is, clipped to [0, 1]",
            "psnr": {"peak": 1.0, "largest_db": LARGEST_PSNR},
            "ssim": {"window": 11, "sigma": 1.5, "k1": 0.01, "k2": 0.03},
            "lpips": {"version": "0.1", "networks": self.networks},
            "face": {"half_side_m": self.face_half_side, "centre": "the projection of the canonical origin"},
            "foreground_from": FOREGROUND,
        }


LARGEST_PSNR = 100.0  # dB, in place of infinity, which JSON cannot hold
FOREGROUND = 0.5  # coverage from which a pixel is foreground, and opacity from which a render shows something
