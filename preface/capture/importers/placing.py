"""Cameras of another world and unit, brought to a rig's frame in metres."""

from collections.abc import Mapping

from preface.capture.rig import RigCamera
from preface.geometry.transforms import Similarity


def placed(cameras: Mapping[str, RigCamera], rig_from_world: Similarity) -> dict[str, RigCamera]:
    """The same cameras in the rig's frame, where they see the scaled scene as they saw the scene.

    Args:
        cameras: id to camera, with ``camera_from_world`` as pose.
        rig_from_world: metres from the world's unit.
    """
    return {
        name: RigCamera.at(
            camera.camera, rig_from_world.apply_to_pose(camera.camera_from_rig.inverse).inverse
        )
        for name, camera in cameras.items()
    }
