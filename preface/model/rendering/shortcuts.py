"""What a renderer may leave out, each with what it costs and saves; and the qualities, which are choices of them.

    render = accelerate(model, code, space, QUALITIES["balanced"])     # rays in scene units to what they see
    image = render_image(render, space, camera, pose, rays_at_a_time=4096)

A renderer belongs to one code: where codes move from frame to frame, each frame has its own. Nothing here imports
torch before `accelerate` is called, so that command lines can list the fields.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from torch import Tensor

    from preface.model.model import PriorModel
    from preface.model.rendering.image import RenderRays, Space


@dataclass(frozen=True)
class Shortcuts:
    """Shortcuts of rendering; with the defaults everything is evaluated as it was trained.

    Figures are means over three heads of a `small` prior at views of 96x144 that it had not seen, CPU time on one
    thread as a share of the model's without shortcuts; `tools/measure_tradeoff.py` measures them for other models.

    Raises:
        ValueError: a value that cannot be, named by its field.
    """

    folded: bool = False
    """Fold the code into the networks' biases once, not at every call; all other shortcuts do so too. Exact to
    rounding."""
    occupancy: int = 0
    """Cubes along the box's longest side, at whose corners the density is evaluated before rays are cast; rays that
    meet no occupied cube are not evaluated, others between the first and the last that they meet; 0: no grid. 64,
    alone: 0.63 of the time, 53 dB to the render without; it takes as long to prepare as 3,000 rays, of which an
    image of 96x144 has 14,000."""
    empty_alpha: float = 0.001
    """Opacity that a cube of the grid may have and still count as empty; a fog thinner than that is lost. From 0.001 to
    0.01: the same figures, 1 % fewer rays on a trained head."""
    skipped_rounds: int = 0
    """Proposal rounds, from the first, in whose place the grid says where light may stop; more than there are: all.
    All, with 64 cubes and bf16: 0.24 of the time; 49.5 dB to the fullest render, from which the model as trained is
    48.4 dB."""
    sample_share: float = 1.0
    """Share of the last round's samples that are placed, of those that the model was trained with. 0.75 after the
    above: 0.19 of the time, 46.6 dB to the fullest render, 0.02 dB to photographs."""
    short_share: float = 1.0
    """The same for rays whose light stops within a short piece, if it is less. 0.5, of 3 cm, after the same: 0.20 of
    the time, 47.6 dB to the fullest render."""
    short: float = 0.02
    """How long, in metres, a short piece is."""
    weight_bound: float = 0.0
    """Samples that can get at most this share of the ray's light are not evaluated. 0.002: 11 % of the samples,
    less than 0.01 dB."""
    color_bound: float = 0.0
    """Samples that got at most this share of the ray's light have no colour and no normal. 0.002: from 49.5 to 49.2
    dB to the fullest render."""
    opaque_normals: bool = False
    """Find normals only of rays that show one, those of which half the light stops; no other ray's are shown."""
    predicted_normals: bool = False
    """Show the normals that a head predicts, where it does, in place of the density's: smooth, and without
    derivatives. Of three heads of a `small` prior after 200 steps of finetuning they were off by 38 to 41 degrees
    (median over views not fitted to), the density's by 21 to 26 (`tools/bench/head_truth.py`)."""
    matmul: Literal["", "fp32", "bf16"] = ""
    """Precision of products inside the networks; by default as trained. bf16: 0.71 of the time on a processor that
    has such products, 68 dB to the render without; one that is not faster with them, which is tried once, takes
    fp32."""
    levels: int = 0
    """Levels of the position's encoding that are kept, from the lowest; 0: all. Of 11, 10: 67.5 dB to the render
    with all; 9: 52.5 dB."""

    def __post_init__(self) -> None:
        for name in ("occupancy", "skipped_rounds", "levels"):
            _require(getattr(self, name) >= 0, name, getattr(self, name), "0 or more")
        for name in ("empty_alpha", "weight_bound", "color_bound"):
            _require(0 <= getattr(self, name) < 1, name, getattr(self, name), "a share, from 0 to below 1")
        for name in ("sample_share", "short_share"):
            _require(0 < getattr(self, name) <= 1, name, getattr(self, name), "a share, above 0 and up to 1")
        _require(self.short >= 0, "short", self.short, "a length in metres")
        _require(self.matmul in ("", "fp32", "bf16"), "matmul", self.matmul, "fp32, bf16 or empty")
        grid = self.occupancy > 0 or self.skipped_rounds == 0
        _require(grid, "skipped_rounds", self.skipped_rounds, "0 without a grid, see occupancy")

    @property
    def skips(self) -> bool:
        """Whether anything is left out that the model by itself would evaluate."""
        bounds = self.weight_bound > 0 or self.color_bound > 0
        fewer = self.sample_share < 1 or self.short_share < 1
        return self.occupancy > 0 or fewer or bounds or self.opaque_normals

    @property
    def changes_model(self) -> bool:
        """Whether the networks themselves are others."""
        return self.matmul != "" or self.levels > 0


def _require(holds: bool, name: str, value: object, wanted: str) -> None:
    if not holds:
        raise ValueError(f"{name}: {value!r}; it has to be {wanted}")


QUALITIES: dict[str, Shortcuts] = {
    "draft": Shortcuts(
        folded=True,
        occupancy=48,
        skipped_rounds=8,
        sample_share=0.5,
        weight_bound=0.005,
        color_bound=0.005,
        opaque_normals=True,
        matmul="bf16",
    ),
    "balanced": Shortcuts(
        folded=True,
        occupancy=64,
        skipped_rounds=8,
        sample_share=0.75,
        weight_bound=0.005,
        color_bound=0.005,
        opaque_normals=True,
        matmul="bf16",
    ),
    "reference": Shortcuts(),
}
DEFAULT_QUALITY = "balanced"


def accelerate(
    model: PriorModel,
    code: Tensor | None,
    space: Space,
    shortcuts: Shortcuts,
    *,
    background: float = 0.0,
    normals: bool = False,
) -> RenderRays:
    """Prepare to render one head; with a grid, that evaluates the density at all corners of its cubes.

    Args:
        model: of the head, on the device where rays will be.
        code: [latent] of the head; None for a model without codes.
        space: of the model, the outside of whose box is empty, also where the model was trained beyond it.
        shortcuts: which.
        background: grey value behind the head.
        normals: whether rays are to find normals.

    Returns:
        Rays to what they see, as `render_image` takes it. With shortcuts that skip, `Render.levels` has the last
        round alone, of the rays in `Render.evaluated`, and normals of one kind.

    Raises:
        ValueError: a code of another length, or a model with codes and none given.
    """
    from preface.model.rendering.accelerated import accelerated

    return accelerated(model, code, space, shortcuts, background, normals)
