"""Rig adjustment by pycolmap (Ceres), as a second opinion on our own.

The board is the world and does not move; the rig moves before it, frame by frame. pycolmap knows no board
warp: the board keeps the shape that it comes with.
"""

from __future__ import annotations

from dataclasses import replace
from types import ModuleType

import numpy as np

from preface.capture.calibration.adjustment import (
    CAUCHY_SIGMAS,
    PRUNE_ROUNDS,
    Adjusted,
    spread,
    within,
)
from preface.capture.calibration.errors import CalibrationError
from preface.capture.calibration.normal_equations import board_shape, residuals
from preface.capture.calibration.state import RigState
from preface.capture.calibration.views import BoardViews
from preface.geometry.transforms import Rigid


def adjust_with_colmap(
    views: BoardViews, state: RigState, trusted: np.ndarray, image_sizes: tuple[tuple[int, int], ...]
) -> Adjusted:
    """Do what `adjust_robustly` does, with pycolmap as the solver and the board's shape held.

    Args:
        views, state: the problem and where to start.
        trusted: [V, P], sightings that are likely right.
        image_sizes: (width, height) per camera.

    Raises:
        CalibrationError: pycolmap is not installed, or gives up.
    """
    for _ in range(2):  # the second time with the scale that the first solution suggests
        scale = CAUCHY_SIGMAS * spread(residuals(views, state), trusted)
        state = minimise_with_colmap(views, state, trusted, image_sizes, cauchy=scale)
    used = within(views, residuals(views, state), trusted & views.seen)
    for _ in range(PRUNE_ROUNDS):
        state = minimise_with_colmap(views, state, used, image_sizes)
        residual = residuals(views, state)
        before, used = used, within(views, residual, used)
        if np.array_equal(before, used):
            break
    return Adjusted(state, used, np.where(views.seen[..., None], residual, np.nan))


def minimise_with_colmap(
    views: BoardViews,
    state: RigState,
    used: np.ndarray,
    image_sizes: tuple[tuple[int, int], ...],
    cauchy: float | None = None,
) -> RigState:
    """Run one rig bundle adjustment over the used sightings [V, P], with Cauchy's loss if a scale is given."""
    colmap = _pycolmap()
    reconstruction, points = build_reconstruction(colmap, views, state, used, image_sizes)
    options, config = _configured(colmap, views, points, cauchy)
    summary = colmap.create_default_bundle_adjuster(options, config, reconstruction).solve()
    if not summary.is_solution_usable():
        raise CalibrationError("backend: pycolmap found no usable solution; use the default backend")
    return _state_of(reconstruction, views, state)


def _pycolmap() -> ModuleType:
    try:
        import pycolmap
    except ImportError as error:
        raise CalibrationError(
            "backend: pycolmap is not installed; run `pip install pycolmap`, or use the default backend"
        ) from error
    return pycolmap


def build_reconstruction(
    colmap: ModuleType,
    views: BoardViews,
    state: RigState,
    used: np.ndarray,
    image_sizes: tuple[tuple[int, int], ...],
) -> tuple:
    """Return a pycolmap.Reconstruction of the rig before the board, and the ids of the board's points.

    Camera c has the id c + 1, frame f the id f + 1, view v the image id v + 1.
    """
    reconstruction = colmap.Reconstruction()
    rig = colmap.Rig(rig_id=1)
    for camera, (size, params) in enumerate(zip(image_sizes, state.params, strict=True)):
        entry = colmap.Camera(
            model=state.model, width=size[0], height=size[1], params=params, camera_id=camera + 1
        )
        reconstruction.add_camera(entry)
        if camera == 0:
            rig.add_ref_sensor(entry.sensor_id)
        else:
            rig.add_sensor(entry.sensor_id, _to_colmap(colmap, state.camera_from_rig, camera))
    reconstruction.add_rig(rig)
    shape = board_shape(views, state.warp)
    points = [reconstruction.add_point3D(point, colmap.Track(), np.zeros(3, np.uint8)) for point in shape]
    for frame in np.unique(views.frame):
        entry = colmap.Frame(frame_id=int(frame) + 1, rig_id=1)
        for view in np.flatnonzero(views.frame == frame):
            sensor = reconstruction.camera(int(views.camera[view]) + 1).sensor_id
            entry.add_data_id(colmap.data_t(sensor, int(view) + 1))
        entry.rig_from_world = _to_colmap(colmap, state.rig_from_board, int(frame))
        reconstruction.add_frame(entry)
    for view in range(len(views)):
        seen = np.flatnonzero(used[view])
        image = colmap.Image(
            name=f"{view}",
            points2D=colmap.Point2DList([colmap.Point2D(xy) for xy in views.pixels[view, seen]]),
            camera_id=int(views.camera[view]) + 1,
            image_id=view + 1,
        )
        image.frame_id = int(views.frame[view]) + 1
        reconstruction.add_image(image)
        for index, point in enumerate(seen):
            reconstruction.add_observation(points[point], colmap.TrackElement(view + 1, index))
    for frame in np.unique(views.frame):
        reconstruction.register_frame(int(frame) + 1)
    return reconstruction, points


def _configured(colmap: ModuleType, views: BoardViews, points: list, cauchy: float | None) -> tuple:
    options = colmap.BundleAdjustmentOptions()
    options.refine_principal_point = True
    options.print_summary = False
    # The default solver, SPARSE_NORMAL_CHOLESKY, is twice as fast here as the automatic choice.
    options.ceres.auto_select_solver_type = False
    options.ceres.solver_options.function_tolerance = 1e-6 if cauchy else 1e-14
    options.ceres.solver_options.gradient_tolerance = 1e-16
    if cauchy:
        options.ceres.loss_function_type = colmap.LossFunctionType.CAUCHY
        options.ceres.loss_function_scale = cauchy
    config = colmap.BundleAdjustmentConfig()
    for view in range(len(views)):
        config.add_image(view + 1)
    for point in points:
        config.add_constant_point(point)  # which fixes the gauge, too
    return options, config


def _state_of(reconstruction: object, views: BoardViews, start: RigState) -> RigState:
    """Read the adjusted numbers back."""
    rig = reconstruction.rigs[1]  # type: ignore[attr-defined]
    cameras = [reconstruction.camera(c + 1) for c in range(views.cameras)]  # type: ignore[attr-defined]
    rotation, translation = start.camera_from_rig.rotation.copy(), start.camera_from_rig.translation.copy()
    for c, camera in enumerate(cameras[1:], start=1):
        pose = rig.sensor_from_rig(camera.sensor_id)
        rotation[c], translation[c] = pose.rotation.matrix(), pose.translation
    boards = start.rig_from_board
    board_rotation, board_translation = boards.rotation.copy(), boards.translation.copy()
    for frame in np.unique(views.frame):
        pose = reconstruction.frame(int(frame) + 1).rig_from_world  # type: ignore[attr-defined]
        board_rotation[frame], board_translation[frame] = pose.rotation.matrix(), pose.translation
    return replace(
        start,
        params=np.stack([camera.params for camera in cameras]),
        camera_from_rig=Rigid(rotation, translation),
        rig_from_board=Rigid(board_rotation, board_translation),
    )


def _to_colmap(colmap: ModuleType, poses: Rigid, index: int) -> object:
    return colmap.Rigid3d(colmap.Rotation3d(poses.rotation[index]), poses.translation[index])
