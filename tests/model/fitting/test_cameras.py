"""Corrections of cameras: against scipy and float64, and on a scene whose colours are known in closed form."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from preface.geometry import Box, Camera, Rigid, Views
from preface.geometry.rays import cast_rays, pixel_centers
from preface.geometry.transforms import nearest_rotation
from preface.model.fitting.cameras import CameraCorrections, corrected_pose, rotated
from preface.model.rays import Rays

SCALE = 4.0
BOX = Box(np.array([-0.2, -0.25, -0.25]), np.array([0.2, 0.25, 0.12]))
ANGLES = [0.0, 1e-30, 1e-12, 1e-8, 1e-4, 0.0099999, 0.0100001, 0.5, math.pi - 1e-8, math.pi]
AXIS = np.array([2.0, -1.0, 0.5]) / np.linalg.norm([2.0, -1.0, 0.5])


def pose_at(azimuth: float, height: float = 0.1) -> Rigid:
    """canonical_from_camera a metre away, looking at the origin."""
    center = np.array([math.sin(azimuth), height, math.cos(azimuth)])
    forward = -center / np.linalg.norm(center)
    right = np.cross([0.0, -1.0, 0.0], forward)
    return Rigid(nearest_rotation(np.stack([right, np.cross(forward, right), forward], axis=1)), center)


def rays_of(pose: Rigid, size: int = 12, dtype: torch.dtype = torch.float64, focal: float = 1.8) -> Rays:
    """All rays of a square camera, in scene units, between the faces of the box."""
    camera = Camera("PINHOLE", size, size, np.array([focal * size, focal * size, size / 2, size / 2]))
    cast = cast_rays(Views.stack([camera], [pose])[0], pixel_centers(size, size).reshape(-1, 2))
    near, far, hit = BOX.intersect(cast.origins, cast.directions)
    near, far = np.where(hit, near, 0.7) * SCALE, np.where(hit, far, 1.3) * SCALE
    arrays = (cast.origins * SCALE, cast.directions, cast.viewdirs, cast.radii, near[:, None], far[:, None])
    return Rays(*(torch.from_numpy(x).to(dtype) for x in arrays), torch.from_numpy(hit[:, None]))


def joined(several: list[Rays]) -> tuple[Rays, Tensor]:
    """Rays one after the other, and the number of the camera of each."""
    names = ("origins", "directions", "viewdirs", "radii", "near", "far", "hit")
    view = torch.repeat_interleave(torch.arange(len(several)), torch.tensor([len(one) for one in several]))
    return Rays(**{name: torch.cat([getattr(one, name) for one in several]) for name in names}), view


def corrections_of(rotation: np.ndarray, translation: np.ndarray) -> CameraCorrections:
    made = CameraCorrections(len(rotation)).double()
    with torch.no_grad():
        made.rotation.copy_(torch.as_tensor(rotation))
        made.translation.copy_(torch.as_tensor(translation))
    return made


# ------------------------------------------------------------------------------------------------ rotations


@pytest.mark.parametrize("angle", ANGLES)
def test_rotation_is_that_of_scipy_from_no_angle_to_half_a_turn(angle):
    vectors = np.random.default_rng(0).normal(size=(50, 3))
    expected = Rotation.from_rotvec(angle * AXIS).apply(vectors)
    turn = torch.as_tensor(angle * AXIS)
    exact = rotated(turn.expand(50, 3), torch.as_tensor(vectors)).numpy()
    np.testing.assert_allclose(exact, expected, atol=2e-15)
    single = rotated(turn.float().expand(50, 3), torch.as_tensor(vectors).float()).numpy()
    np.testing.assert_allclose(single, expected, atol=2e-6)


def test_tiny_rotation_moves_a_vector_by_its_cross_product():
    vectors = np.random.default_rng(1).normal(size=(20, 3))
    turn = 1e-8 * AXIS
    moved = rotated(torch.as_tensor(turn).expand(20, 3), torch.as_tensor(vectors)).numpy() - vectors
    np.testing.assert_allclose(moved, np.cross(turn, vectors), atol=1e-15)


@pytest.mark.parametrize("angle", ANGLES)
def test_derivatives_of_a_rotation_equal_finite_differences(angle):
    turn = torch.as_tensor(angle * AXIS).expand(4, 3).clone().requires_grad_()
    vectors = torch.as_tensor(np.random.default_rng(2).normal(size=(4, 3))).requires_grad_()
    assert torch.autograd.gradcheck(rotated, (turn, vectors), atol=1e-7)


@pytest.mark.parametrize("angle", [0.0, 1e-30, 1e-20, 1e-8, math.pi])
def test_derivatives_are_finite_in_float32(angle):
    turn = torch.as_tensor(angle * AXIS).float().expand(8, 3).clone().requires_grad_()
    rotated(turn, torch.eye(3)[:1].expand(8, 3)).square().sum().backward()
    (second,) = torch.autograd.grad(rotated(turn, torch.ones(8, 3))[:, 0].sum(), turn)
    assert turn.grad.isfinite().all()
    assert second.isfinite().all()


# --------------------------------------------------------------------------------------------------- rays


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_no_correction_changes_no_bit(dtype):
    rays = rays_of(pose_at(0.4), dtype=dtype, focal=1.0)
    assert not rays.hit.all()
    corrections = CameraCorrections(3).to(dtype)
    after = corrections.apply(rays, torch.full((len(rays),), 2), BOX, SCALE)
    for name in ("origins", "directions", "viewdirs", "radii", "near", "far", "hit"):
        assert torch.equal(getattr(after, name), getattr(rays, name)), name


def test_rays_without_a_mask_get_one():
    rays = rays_of(pose_at(0.0), focal=4.0)
    bare = Rays(rays.origins, rays.directions, rays.viewdirs, rays.radii, rays.near, rays.far)
    still = CameraCorrections(1).double().apply(bare, torch.zeros(len(bare), dtype=torch.int64), BOX, SCALE)
    assert still.hit.all()
    away = corrections_of(np.array([[0.0, 1.0, 0.0]]), np.zeros((1, 3)))
    assert not away.apply(bare, torch.zeros(len(bare), dtype=torch.int64), BOX, SCALE).hit.any()


def test_a_camera_turns_about_its_own_centre():
    rays, view = joined([rays_of(pose_at(0.3)), rays_of(pose_at(-0.5))])
    turned = corrections_of(np.array([[0.02, -0.3, 0.1], [1.0, 2.0, 0.5]]), np.zeros((2, 3)))
    after = turned.apply(rays, view, BOX, SCALE)
    assert torch.equal(after.origins, rays.origins)
    lengths = (x.directions.norm(dim=-1) for x in (after, rays))
    torch.testing.assert_close(*lengths, rtol=1e-14, atol=0)
    first = view == 0
    angles = (x.viewdirs[first] @ x.viewdirs[first].T for x in (after, rays))
    torch.testing.assert_close(*angles, rtol=0, atol=1e-14)


def test_corrected_rays_are_those_of_the_corrected_camera():
    pose = pose_at(0.5)
    correction = {"rotation": [0.03, -0.02, 0.05], "translation_m": [0.01, 0.004, -0.02]}
    corrections = corrections_of(
        np.array([correction["rotation"]]), SCALE * np.array([correction["translation_m"]])
    )
    before = rays_of(pose)
    after = corrections.apply(before, torch.zeros(len(before), dtype=torch.int64), BOX, SCALE)
    expected = rays_of(corrected_pose(pose, correction))
    for name in ("origins", "directions", "viewdirs", "radii"):
        torch.testing.assert_close(getattr(after, name), getattr(expected, name), rtol=0, atol=1e-13)
    assert torch.equal(after.hit, expected.hit)
    hit = expected.hit
    torch.testing.assert_close(after.near[hit], expected.near[hit], rtol=0, atol=1e-12)
    torch.testing.assert_close(after.far[hit], expected.far[hit], rtol=0, atol=1e-12)
    assert torch.equal(after.near[~hit], before.near[~hit])
    assert torch.equal(after.far[~hit], before.far[~hit])
    assert corrections.described(["front"], SCALE)["front"]["rotation"] == correction["rotation"]
    assert corrections.described(["front"], SCALE)["front"]["translation_m"] == pytest.approx(
        correction["translation_m"], rel=1e-15
    )


@pytest.mark.parametrize("shift", [(0.0, 0.0, -1.0), (0.0, 3.0, 0.0), (0.0, 0.0, 100.0)])
def test_depths_are_those_of_the_box_wherever_the_camera_goes(shift):
    rays = rays_of(pose_at(0.0, height=0.0), focal=0.6)
    moved = corrections_of(np.array([[1e-3, 0, 0]]), SCALE * np.array([shift]))
    after = moved.apply(rays, torch.zeros(len(rays), dtype=torch.int64), BOX, SCALE)
    near, far, hit = BOX.intersect(after.origins.detach() / SCALE, after.directions.detach())
    assert torch.equal(after.hit[:, 0], hit)
    torch.testing.assert_close(after.near[hit, 0], near[hit] * SCALE, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(after.far[hit, 0], far[hit] * SCALE, rtol=1e-12, atol=1e-12)
    assert bool((after.near >= 0).all())
    assert bool((after.near <= after.far).all())


@pytest.mark.parametrize("size", [0.0, 1e-8, 0.01, 2.0])
def test_derivatives_of_rays_equal_finite_differences(size):
    rays, view = joined([rays_of(pose_at(0.3), size=2), rays_of(pose_at(-0.5), size=2)])
    start = corrections_of(size * np.random.default_rng(4).normal(size=(2, 3)), np.full((2, 3), size))

    def formed(rotation: Tensor, translation: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        parameters = {"corrections.rotation": rotation, "corrections.translation": translation}
        after = torch.func.functional_call(_Applied(start), parameters, (rays, view))
        return after.origins, after.directions, after.viewdirs

    inputs = tuple(p.detach().clone().requires_grad_() for p in (start.rotation, start.translation))
    assert torch.autograd.gradcheck(formed, inputs, atol=1e-7)


class _Applied(torch.nn.Module):
    """Corrections as a function of their parameters."""

    def __init__(self, corrections: CameraCorrections):
        super().__init__()
        self.corrections = corrections

    def forward(self, rays: Rays, view: Tensor) -> Rays:
        return self.corrections.apply(rays, view, BOX, SCALE)


# --------------------------------------------------------------------------------------------- learning


def sphere_colors(rays: Rays, radius: float = 0.45) -> Tensor:
    """What rays see of a ball about the origin with a smooth pattern, scene units; black beside it, softly."""
    along = (rays.origins * rays.viewdirs).sum(dim=-1, keepdim=True)
    closest = rays.origins - along * rays.viewdirs
    inside = radius**2 - closest.square().sum(dim=-1, keepdim=True)
    point = closest - inside.clamp_min(1e-4).sqrt() * rays.viewdirs
    pattern = 0.5 + 0.25 * (torch.sin(11 * point) + torch.cos(17 * point.roll(1, dims=-1)))
    return pattern * torch.sigmoid(inside / 0.01)


def test_descent_finds_perturbed_cameras_again():
    rng = np.random.default_rng(7)
    poses = [pose_at(-0.6), pose_at(0.0, 0.3), pose_at(0.7, -0.1)]
    turns = math.radians(0.5) * rng.normal(size=(3, 3))
    shifts = 2e-3 * rng.normal(size=(3, 3))
    truth, view = joined([rays_of(pose, size=16) for pose in poses])
    seen = sphere_colors(truth)
    wrong = [
        corrected_pose(pose, {"rotation": turn, "translation_m": shift})
        for pose, turn, shift in zip(poses, turns, shifts, strict=True)
    ]
    rays, _ = joined([rays_of(pose, size=16) for pose in wrong])
    corrections = CameraCorrections(3).double()
    descent = torch.optim.LBFGS(
        corrections.parameters(),
        lr=1.0,
        max_iter=70,
        tolerance_grad=1e-12,
        tolerance_change=1e-15,
        line_search_fn="strong_wolfe",
    )

    def misfit() -> Tensor:
        descent.zero_grad()
        loss = (sphere_colors(corrections.apply(rays, view, BOX, SCALE)) - seen).square().mean()
        loss.backward()
        return loss

    first = misfit().item()
    descent.step(misfit)
    found = corrections.described(["a", "b", "c"], SCALE)
    assert misfit().item() < 1e-3 * first
    for pose, off, name in zip(poses, wrong, "abc", strict=True):
        after = corrected_pose(off, found[name])
        turned = Rotation.from_matrix(after.rotation.T @ pose.rotation).magnitude()
        assert turned < math.radians(0.03)
        assert np.linalg.norm(after.translation - pose.translation) < 5e-4  # of about 3.5e-3


def test_penalty_is_the_sum_of_squared_deviations_over_two():
    one = corrections_of(np.full((4, 3), math.radians(0.5)), np.full((4, 3), 2e-3 * SCALE))
    assert one.penalty(SCALE).item() == pytest.approx(3.0, rel=1e-12)
    twice = corrections_of(np.full((4, 3), math.radians(0.5)), np.full((4, 3), 2e-3 * SCALE))
    wide = twice.penalty(SCALE, math.radians(1.0), 4e-3).item()
    assert wide == pytest.approx(0.75, rel=1e-12)
    assert CameraCorrections(2).penalty(SCALE).item() == 0.0


def test_penalty_pulls_to_zero_and_leaves_zero_alone():
    none = CameraCorrections(2)
    none.penalty(SCALE).backward()
    assert not none.rotation.grad.any()
    some = corrections_of(np.array([[0.1, -0.1, 0.0]]), np.array([[0.0, 0.2, -0.3]]))
    some.penalty(SCALE).backward()
    for values in (some.rotation, some.translation):
        assert torch.equal(values.grad.sign(), values.detach().sign())
