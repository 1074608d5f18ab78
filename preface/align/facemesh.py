"""MediaPipe's face models behind two functions: where faces are, and the landmarks of one in an upright crop.

The crop is made by us and handed over whole: the landmark model sees 192x192 pixels whatever the photograph's
size, so that what matters is that those are averaged from the full-resolution ones. MediaPipe's own FaceMesh
solution would find the face again in every crop, with a detector that gives up on side views.

One `FaceModels` belongs to one process; MediaPipe's graphs survive neither pickling nor a fork.
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from preface.artifacts import ArtifactError
from preface.capture.chatter import without_chatter

CROP_SIDE = 192  # pixels: the input of the landmark model shipped with mediapipe 0.10.21
TASK_CROP_SIDE = 384  # pixels: a .task file brings its own detector, and a model of 256 pixels
# The region of the landmark model against the box of the landmarks, as MediaPipe's own pipeline has it.
REGION_OVER_BOX = 1.5
DETECTION_CONFIDENCE = 0.4  # lower than MediaPipe's 0.5: the landmark model judges again
_GRAPH = """
input_stream: "image"
input_stream: "region"
output_stream: "landmarks"
node {
  calculator: "ConstantSidePacketCalculator"
  output_side_packet: "PACKET:with_attention"
  node_options: {
    [type.googleapis.com/mediapipe.ConstantSidePacketCalculatorOptions]: { packet { bool_value: true } }
  }
}
node {
  calculator: "FaceLandmarkCpu"
  input_stream: "IMAGE:image"
  input_stream: "ROI:region"
  input_side_packet: "WITH_ATTENTION:with_attention"
  output_stream: "LANDMARKS:landmarks"
}
"""
# What MediaPipe and TensorFlow Lite say on every start: nothing that a user could act on.
_CHATTER = re.compile(
    r"^(INFO: |[IW]\d{4} .*(feedback_manager|landmark_projection_calculator|gl_context|face_landmarker_graph)"
    r"|WARNING: All log messages before absl::InitializeLog)"
)


class FaceModelError(ArtifactError):
    """MediaPipe is missing, or a landmark model cannot be used."""


@dataclass(frozen=True, eq=False)
class FaceBox:
    """A face as the detector sees it, in pixels of the image it was given.

    Attributes:
        centre: [2] of the face.
        side: of the square around it.
        roll: radians by which the line from the subject's right eye to the left is turned clockwise.
        score: the detector's, 0 to 1.
    """

    centre: np.ndarray
    side: float
    roll: float
    score: float


class LandmarkModel(Protocol):
    """Finds the landmarks of the face that fills an upright, square crop."""

    crop_side: int

    def landmarks(self, crop: np.ndarray) -> np.ndarray | None:
        """Landmarks [478, 3] in pixels of the uint8 RGB crop [S, S, 3], z growing away from the camera in the
        same unit; None when there is no face.
        """
        ...


class FaceModels:
    """The detectors and the landmark model of one process."""

    def __init__(self, landmark_model: Path | None):
        """Load the models.

        Args:
            landmark_model: a ``face_landmarker.task`` file; None takes the model shipped with mediapipe.

        Raises:
            FaceModelError: mediapipe is not installed, or the file is no landmark model.
        """
        try:
            with without_chatter(_CHATTER):
                import mediapipe

                self._detectors = [
                    mediapipe.solutions.face_detection.FaceDetection(
                        min_detection_confidence=DETECTION_CONFIDENCE, model_selection=selection
                    )
                    for selection in (0, 1)  # short range, full range
                ]
                # What is said on the first image, by threads that outlive the constructors, is said here.
                self.faces(np.zeros((CROP_SIDE, CROP_SIDE, 3), np.uint8))
                self.model: LandmarkModel = (
                    _ShippedModel() if landmark_model is None else _TaskModel(landmark_model)
                )
                self.model.landmarks(np.zeros((self.model.crop_side, self.model.crop_side, 3), np.uint8))
        except ImportError as error:
            remedy = "Install it as tools/setup.sh does, or give landmarks of another program"
            raise FaceModelError("mediapipe", "package", f"cannot be imported ({error})", remedy) from error

    def faces(self, image: np.ndarray) -> list[FaceBox]:
        """All faces that either detector sees in a uint8 RGB image, the same face perhaps twice."""
        height, width = image.shape[:2]
        found = []
        for detector in self._detectors:
            for detection in detector.process(np.ascontiguousarray(image)).detections or []:
                location = detection.location_data
                box, eyes = location.relative_bounding_box, location.relative_keypoints[:2]
                centre = np.array([(box.xmin + box.width / 2) * width, (box.ymin + box.height / 2) * height])
                across = [(eyes[1].x - eyes[0].x) * width, (eyes[1].y - eyes[0].y) * height]
                side = max(box.width * width, box.height * height)
                roll = float(np.arctan2(across[1], across[0]))
                found.append(FaceBox(centre, side, roll, float(detection.score[0])))
        return found


class _ShippedModel:
    """FaceMesh with attention for eyes and lips, as shipped with mediapipe 0.10.21."""

    crop_side = CROP_SIDE

    def __init__(self) -> None:
        import mediapipe
        from mediapipe.framework.formats import rect_pb2
        from mediapipe.python import packet_creator, packet_getter
        from mediapipe.python._framework_bindings import resource_util

        resource_util.set_resource_dir(str(Path(mediapipe.__file__).parent.parent))
        self._graph = mediapipe.CalculatorGraph(graph_config=_GRAPH)
        self._answer: list[Any] = []
        self._graph.observe_output_stream("landmarks", lambda _, packet: self._answer.append(packet))
        self._graph.start_run()
        self._time = 0
        self._make_image = lambda crop: packet_creator.create_image_frame(
            data=crop, image_format=mediapipe.ImageFormat.SRGB
        )
        whole = rect_pb2.NormalizedRect(x_center=0.5, y_center=0.5, width=1.0, height=1.0)
        self._make_region = lambda: packet_creator.create_proto(whole)
        self._read = packet_getter.get_proto

    def landmarks(self, crop: np.ndarray) -> np.ndarray | None:
        self._time += 1
        self._answer.clear()
        image = self._make_image(np.ascontiguousarray(crop))
        self._graph.add_packet_to_input_stream("image", image.at(self._time))
        self._graph.add_packet_to_input_stream("region", self._make_region().at(self._time))
        self._graph.wait_until_idle()
        if not self._answer or self._answer[0].is_empty():
            return None
        return _in_pixels(self._read(self._answer[0]).landmark, crop)


class _TaskModel:
    """A face_landmarker.task file through the Tasks interface, which searches the crop for the face itself."""

    crop_side = TASK_CROP_SIDE

    def __init__(self, path: Path):
        import mediapipe
        from mediapipe.tasks.python import BaseOptions, vision

        self._path = path
        try:
            options = vision.FaceLandmarkerOptions(
                base_options=BaseOptions(model_asset_buffer=path.read_bytes()),
                running_mode=vision.RunningMode.IMAGE,
            )
            self._landmarker = vision.FaceLandmarker.create_from_options(options)
        except OSError as error:
            raise FaceModelError.from_os(path, "file", error) from error
        except (RuntimeError, ValueError) as error:
            raise self._refused(f"is no face landmark model ({_shortened(error)})") from error
        self._image = lambda crop: mediapipe.Image(image_format=mediapipe.ImageFormat.SRGB, data=crop)

    def landmarks(self, crop: np.ndarray) -> np.ndarray | None:
        try:
            faces = self._landmarker.detect(self._image(np.ascontiguousarray(crop))).face_landmarks
        except RuntimeError as error:
            raise self._refused(f"fails ({_shortened(error)})") from error
        if not faces:
            return None
        points = _in_pixels(faces[0], crop)
        if len(points) != 478:
            raise self._refused(f"gives {len(points)} landmarks instead of 478")
        return points

    def _refused(self, problem: str) -> FaceModelError:
        remedy = "Download MediaPipe's face_landmarker.task again, or leave --landmark-model out"
        return FaceModelError(self._path, "landmark model", problem, remedy)


def _shortened(error: Exception) -> str:
    return " ".join(str(error).split())[:200]


def _in_pixels(landmarks: Any, crop: np.ndarray) -> np.ndarray:
    return np.array([(point.x, point.y, point.z) for point in landmarks]) * crop.shape[0]
