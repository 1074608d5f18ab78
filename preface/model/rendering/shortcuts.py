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

    The README's table "Speed for accuracy" has what each saves and costs, alone and after the others;
    `tools/measure_tradeoff.py` measures it for other models.

    Raises:
        ValueError: a value that cannot be, named by its field.
    """

    folded: bool = False
    """Fold the code into the networks' biases once, not at every call; all other shortcuts do so too. Exact to
    rounding."""
    occupancy: int = 0
    """Cubes along the box's longest side, at whose corners the density is evaluated before rays are cast; rays that
    meet no occupied cube are not evaluated, others between the first and the last that they meet; 0: no grid. Finer
    cubes leave less to evaluate and take longer to prepare, which pays for an image and not for a few rays."""
    empty_alpha: float = 0.001
    """Opacity that a cube of the grid may have and still count as empty; a fog thinner than that is lost. More leaves
    out more rays."""
    skipped_rounds: int = 0
    """Proposal rounds, from the first, in whose place the grid says where light may stop; more than there are: all.
    Each that is skipped saves its network; the samples of the last round are then as right as the grid is fine."""
    sample_share: float = 1.0
    """Share of the last round's samples that are placed, of those that the model was trained with. Time goes with
    it; fewer find an edge less exactly."""
    short_share: float = 1.0
    """The same for rays whose light stops within a short piece, if it is less."""
    short: float = 0.02
    """How long, in metres, a short piece is."""
    weight_bound: float = 0.0
    """Samples that can get at most this share of the ray's light are not evaluated; what they add up to
    is missing."""
    color_bound: float = 0.0
    """Samples that got at most this share of the ray's light have no colour and no normal; what they add up to is
    missing."""
    opaque_normals: bool = False
    """Find normals only of rays that show one, those of which half the light stops; no other ray's are shown."""
    predicted_normals: bool = False
    """Show the normals that a head predicts, where it does, in place of the density's: smooth, and without
    derivatives, but further off; `tools/bench/head_truth.py` measures both against heads that are known."""
    matmul: Literal["", "fp32", "bf16"] = ""
    """Precision of products inside the networks; by default as trained. bf16 is faster on a processor that has
    such products; one that is not faster with them, which is tried once, takes fp32."""
    levels: int = 0
    """Levels of the position's encoding that are kept, from the lowest; 0: all. Fewer blur what is fine."""

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
