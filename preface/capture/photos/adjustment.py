"""Bundle adjustment of a structure by pycolmap (Ceres)."""

from dataclasses import dataclass, replace

import numpy as np
import pycolmap

from preface.capture.photos.structure import Structure, Tracks
from preface.geometry.cameras import Camera
from preface.geometry.transforms import Rigid

# Scale of the Cauchy loss: mapping has left mismatches of up to 4 px among sightings good to half a pixel.
LOSS_PIXELS = 1.0
# Stopping when a step gains less than this share of the cost leaves a lens within a hundredth of its standard
# deviation; a tenth of it costs 20% more iterations.
FUNCTION_TOLERANCE = 1e-6
MAX_ITERATIONS = 100


@dataclass(frozen=True)
class Refine:
    """What of the lenses an adjustment may change; poses and points are always free.

    Attributes:
        lens: focal lengths and distortion.
        principal_point: that too.
    """

    lens: bool
    principal_point: bool


def adjust(structure: Structure, tracks: Tracks, refine: Refine, threads: int) -> Structure:
    """Minimise the Cauchy loss of the reprojection errors.

    Args:
        structure: where to start.
        tracks: the sightings; points that none of them shows stay where they are.
        refine: what may change.
        threads: for Ceres.

    Returns:
        The structure at the minimum, in a gauge of its own.
    """
    reconstruction = _reconstruction(structure, tracks)
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in reconstruction.images:
        config.add_image(image_id)
    if not refine.lens:
        for camera_id in reconstruction.cameras:
            config.set_constant_cam_intrinsics(camera_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point = refine.principal_point
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = LOSS_PIXELS
    options.ceres.solver_options.function_tolerance = FUNCTION_TOLERANCE
    options.ceres.solver_options.max_num_iterations = MAX_ITERATIONS
    options.ceres.solver_options.num_threads = threads
    pycolmap.create_default_bundle_adjuster(options, config, reconstruction).solve()
    return _read_back(structure, tracks, reconstruction)


def read_poses(images: list[pycolmap.Image]) -> Rigid:
    """The poses of pycolmap's images as one batch."""
    poses = [image.cam_from_world() for image in images]
    rotations = np.stack([pose.rotation.matrix() for pose in poses])
    return Rigid(rotations, np.stack([pose.translation for pose in poses]))


def _reconstruction(structure: Structure, tracks: Tracks) -> pycolmap.Reconstruction:
    """The same as pycolmap's object: camera, image and point ids are ours plus one."""
    result = pycolmap.Reconstruction()
    for index, camera in enumerate(structure.cameras):
        result.add_camera_with_trivial_rig(
            pycolmap.Camera(
                camera_id=index + 1,
                model=camera.model,
                width=camera.width,
                height=camera.height,
                params=camera.params,
            )
        )
    slot = np.empty(len(tracks), int)  # of each sighting among those of its image
    matrices = structure.camera_from_world.matrix[:, :3]
    for index, camera_index in enumerate(tracks.camera_of_image):
        seen = np.flatnonzero(tracks.image == index)
        slot[seen] = np.arange(len(seen))
        image = pycolmap.Image(
            name=str(index),
            keypoints=tracks.pixels[seen],
            camera_id=int(camera_index) + 1,
            image_id=index + 1,
        )
        result.add_image_with_trivial_frame(image, pycolmap.Rigid3d(matrices[index]))
    order = np.argsort(tracks.point, kind="stable")
    points, starts = np.unique(tracks.point[order], return_index=True)
    for point, sightings in zip(points, np.split(order, starts[1:]), strict=True):
        elements = [pycolmap.TrackElement(int(tracks.image[m]) + 1, int(slot[m])) for m in sightings]
        entry = pycolmap.Point3D(xyz=structure.points[point], track=pycolmap.Track(elements))
        result.add_point3D_with_id(int(point) + 1, entry)
    return result


def _read_back(structure: Structure, tracks: Tracks, solved: pycolmap.Reconstruction) -> Structure:
    cameras = tuple(
        Camera(old.model, old.width, old.height, np.array(solved.cameras[index + 1].params))
        for index, old in enumerate(structure.cameras)
    )
    images = [solved.images[index + 1] for index in range(len(tracks.camera_of_image))]
    points = structure.points.copy()
    for point in np.unique(tracks.point):
        points[point] = solved.points3D[int(point) + 1].xyz
    return replace(structure, cameras=cameras, camera_from_world=read_poses(images), points=points)
