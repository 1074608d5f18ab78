"""Meshes of fields whose surface is known."""

import numpy as np
import open3d as o3d
import pytest
import torch

from preface.artifacts import ArtifactError
from preface.geometry import Box
from preface.model.configuration import ModelConfig, NetworkConfig
from preface.model.model import PriorModel
from preface.model.rendering import mesh as mesh_module
from preface.model.rendering.image import Space
from preface.model.rendering.mesh import Field, extract_mesh, model_field, write_mesh

SPACE = Space(Box(np.array([-0.15, -0.2, -0.14]), np.array([0.15, 0.22, 0.16])), 1 / 0.21)
CENTER, RADIUS = np.array([0.01, -0.02, 0.03]), 0.08  # metres


def ball(steepness: float, floater: bool = False) -> Field:
    """Density that grows exponentially through the sphere, where it stops half the light in a centimetre."""
    middle = np.log(2) / (0.01 * SPACE.scale)

    def density(points):
        inside = RADIUS - (points.double() / SPACE.scale - torch.from_numpy(CENTER)).norm(dim=-1)
        found = middle * torch.exp(steepness * inside)
        if floater:
            far = (points.double() / SPACE.scale - torch.tensor([-0.12, 0.18, -0.1])).norm(dim=-1)
            found = found + middle * torch.exp(steepness * (0.015 - far))
        return found.clamp_max(1e6).float()

    def color(points, directions):
        return (1 - directions) / 2

    return Field(density, color)


@pytest.mark.parametrize("steepness", [100.0, 1000.0])
def test_a_ball_has_its_radius_closed_and_facing_outwards(steepness):
    mesh = extract_mesh(ball(steepness), SPACE, 64)
    offset = mesh.vertices - CENTER
    voxel = 0.42 / 64
    np.testing.assert_allclose(np.linalg.norm(offset, axis=1), RADIUS, atol=0.05 * voxel)
    made = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(mesh.vertices), o3d.utility.Vector3iVector(mesh.triangles)
    )
    assert made.is_watertight()
    assert made.get_volume() == pytest.approx(
        4 / 3 * np.pi * RADIUS**3, rel=0.02
    )  # positive if facing outwards
    # Colours are those seen straight on: direction of view against the normal.
    np.testing.assert_allclose(mesh.colors, (1 + offset / RADIUS) / 2, atol=0.05)


def test_no_more_points_are_evaluated_together_than_memory_was_meant_for(monkeypatch):
    whole, field, together = extract_mesh(ball(100.0), SPACE, 32), ball(100.0), []

    def noted(evaluate):
        def call(*points):
            together.append(len(points[0]))
            return evaluate(*points)

        return call

    monkeypatch.setattr(mesh_module, "SLAB_POINTS", 300)
    parts = extract_mesh(Field(noted(field.density), noted(field.color)), SPACE, 32)
    assert len(whole.vertices) > 600
    assert max(together) == 300
    np.testing.assert_array_equal(parts.triangles, whole.triangles)
    np.testing.assert_array_equal(parts.vertices, whole.vertices)
    np.testing.assert_array_equal(parts.colors, whole.colors)


def test_what_floats_apart_is_left_out():
    mesh = extract_mesh(ball(1000.0, floater=True), SPACE, 64)
    assert np.linalg.norm(mesh.vertices - CENTER, axis=1).max() < RADIUS * 1.05


def test_a_surface_that_leaves_the_box_is_closed_at_it():
    field = Field(lambda points: torch.full((len(points),), 1e4), lambda p, d: torch.ones_like(p))
    mesh = extract_mesh(field, SPACE, 16)
    voxel = 0.42 / 16
    np.testing.assert_allclose(mesh.vertices.min(0), SPACE.box.minimum, atol=voxel)
    np.testing.assert_allclose(mesh.vertices.max(0), SPACE.box.maximum, atol=2 * voxel)


def test_an_empty_field_and_a_resolution_of_one_are_refused():
    empty = Field(lambda points: torch.zeros(len(points)), lambda p, d: torch.ones_like(p))
    with pytest.raises(ValueError, match="no surface"):
        extract_mesh(empty, SPACE, 8)
    with pytest.raises(ValueError, match="resolution"):
        extract_mesh(empty, SPACE, 1)


def test_a_models_field_has_its_density_along_a_ray():
    """Against rendering: the density that a thin, short frustum sees."""
    torch.manual_seed(3)
    networks = {"proposal": NetworkConfig(2, 8), "nerf": NetworkConfig(3, 16)}
    config = ModelConfig(latent=4, **networks, bottleneck=8, view_width=8, levels=4, samples=(8, 64))
    model = PriorModel(config, 1)
    field = model_field(model, model.codes[0].detach(), 1e-3)
    from preface.model.rays import Rays

    direction = torch.tensor([[0.1, -0.2, 1.0]])
    rays = Rays(
        torch.tensor([[0.1, 0.2, -2.0]]), direction, direction / direction.norm(),
        torch.full((1, 1), 1e-4), torch.full((1, 1), 1.5), torch.full((1, 1), 2.5),
    )  # fmt: skip
    with torch.no_grad():
        level = model(rays, model.codes[:1]).levels[-1]
    middles = (level.tdist[0, 1:] + level.tdist[0, :-1]) / 2
    points = rays.origins + middles[:, None] * direction
    torch.testing.assert_close(field.density(points), level.density[0], rtol=2e-3, atol=1e-4)
    colors = field.color(points, rays.viewdirs.expand(len(points), -1))
    assert colors.shape == points.shape
    assert ((colors > -0.01) & (colors < 1.01)).all()


@pytest.mark.parametrize("suffix", [".ply", ".glb", ".obj"])
def test_files_come_back_as_they_were_written(tmp_path, suffix):
    mesh = extract_mesh(ball(1000.0), SPACE, 24)
    path = write_mesh(tmp_path / f"head{suffix}", mesh)
    again = o3d.io.read_triangle_mesh(str(path))  # another program's reader
    corners = np.asarray(again.vertices)[np.asarray(again.triangles)]
    np.testing.assert_allclose(
        np.sort(corners.reshape(-1, 3), axis=0),
        np.sort(mesh.vertices[mesh.triangles].reshape(-1, 3), axis=0),
        atol=1e-5,
    )
    assert [entry.name for entry in tmp_path.iterdir() if entry.suffix == suffix] == [path.name]


def test_unknown_suffixes_and_unwritable_folders_are_errors(tmp_path):
    mesh = extract_mesh(ball(1000.0), SPACE, 16)
    with pytest.raises(ArtifactError, match="suffix"):
        write_mesh(tmp_path / "head.stl2", mesh)
    with pytest.raises(ArtifactError, match="writing"):
        write_mesh(tmp_path / "absent" / "head.ply", mesh)
