"""Rigs of other programs: reading and writing their files, each in its own convention.

| format                       | what                              | pose, axes                  | top-left pixel |
|------------------------------|-----------------------------------|-----------------------------|----------------|
| `colmap-text`, `colmap-binary` | folder: cameras, images, rigs, frames | world to camera, y down | (0.5, 0.5)     |
| `nerfstudio`                 | `transforms.json`                 | camera to world, y up, z back | (0.5, 0.5)   |
| `opencv`                     | `cv2.FileStorage` YAML or JSON    | world to camera, y down     | (0, 0)         |
| `anipose`                    | `calibration.toml`                | world to camera, y down     | (0, 0)         |
| `caliscope`                  | `camera_array.toml`               | world to camera, y down     | (0, 0)         |
| `facescape`                  | `params.json`                     | world to camera, y down     | (0, 0) inferred |
| `mrcal`                      | folder or file: `.cameramodel`    | world to camera, y down     | (0, 0)         |
| `cafca`                      | folder or file: `C00.json` ...    | world to camera, y down     | (0.5, 0.5) assumed |
| `nersemble`                  | `camera_params.json`              | world to camera, y down     | (0, 0) assumed |

What a format cannot hold is refused, never dropped, except statistics, which no format holds.
"""

from preface.capture.formats.registry import FORMATS, detect, export_rig, read_rig_from

__all__ = ["FORMATS", "detect", "export_rig", "read_rig_from"]
