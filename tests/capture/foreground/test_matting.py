"""The user's ONNX model: a real graph run by onnxruntime, and models that do not fit."""

import builtins
from types import SimpleNamespace

import numpy as np
import pytest

from preface.capture.foreground import ForegroundError, Hints, make_segmenter
from preface.capture.foreground.matting import OnnxMatting


def varint(value):
    out = bytearray()
    while True:
        value, low = value >> 7, value & 127
        out.append(low | (128 if value else 0))
        if not value:
            return bytes(out)


def field(number, content):
    """One field of a protocol buffer: an integer, a text, or a message."""
    if isinstance(content, int):
        return varint(number << 3) + varint(content)
    content = content.encode() if isinstance(content, str) else content
    return varint(number << 3 | 2) + varint(len(content)) + content


def value_info(name, channels):
    """A float tensor [1, channels, height, width] with open sides (onnx.proto, ValueInfoProto)."""
    sides = [field(1, 1), field(1, channels), field(2, "height"), field(2, "width")]
    shape = b"".join(field(1, side) for side in sides)
    return field(1, name) + field(2, field(1, field(1, 1) + field(2, shape)))


def green_channel_model():
    """An ONNX file whose coverage is the green channel of its input: one Slice along the channels."""

    def constant(name, number):
        return field(1, 1) + field(2, 7) + field(8, name) + field(9, int(number).to_bytes(8, "little"))

    names = ("image", "from", "to", "axis")
    node = b"".join(field(1, name) for name in names) + field(2, "alpha") + field(4, "Slice")
    graph = field(1, node) + field(2, "graph")
    graph += b"".join(field(5, constant(n, v)) for n, v in (("from", 1), ("to", 2), ("axis", 1)))
    graph += field(11, value_info("image", 3)) + field(12, value_info("alpha", 1))
    return field(1, 8) + field(7, graph) + field(8, field(2, 13))


class Fake:
    """Behaves like an onnxruntime session."""

    def __init__(self, *outputs, shape=(1, 3, 8, 8), inputs=1):
        self.outputs, self.fed = outputs, None
        self.inputs = [
            SimpleNamespace(name=f"in{i}", shape=list(shape), type="tensor(float)") for i in range(inputs)
        ]

    def get_inputs(self):
        return self.inputs

    def run(self, names, feed):
        self.fed = feed["in0"]
        return self.outputs


def test_a_real_model_gives_its_coverage(tmp_path):
    path = tmp_path / "green.onnx"
    path.write_bytes(green_channel_model())
    pixels = np.zeros((64, 96, 3), np.uint8)
    pixels[:, 48:, 1] = 255
    found = make_segmenter("onnx", path)(pixels, Hints())
    np.testing.assert_allclose(found.alpha, pixels[..., 1] / 255, atol=1e-6)
    assert found.method == "onnx"


def test_a_model_of_lower_resolution_is_refined_along_the_photographs_edges(tmp_path):
    path = tmp_path / "green.onnx"
    path.write_bytes(green_channel_model())
    pixels = np.full((700, 1500, 3), 30, np.uint8)
    pixels[:, 703:, 1] = 255
    alpha = make_segmenter("onnx", path)(pixels, Hints()).alpha
    assert alpha.shape == (700, 1500)
    assert alpha[:, 710:].min() > 0.99
    assert abs(float((alpha[350] >= 0.5).argmax()) - 703) <= 1


def test_the_model_is_fed_rgb_between_zero_and_one():
    session = Fake(np.zeros((1, 1, 8, 8), np.float32))
    OnnxMatting(session, "model.onnx")(np.full((8, 8, 3), (255, 51, 0), np.uint8), Hints())
    assert session.fed.shape == (1, 3, 8, 8)
    assert session.fed.dtype == np.float32
    np.testing.assert_allclose(session.fed[0, :, 4, 4], [1, 0.2, 0], atol=1e-6)


@pytest.mark.parametrize("shape", [(1, 1, 8, 8), (1, 8, 8), (8, 8)])
def test_colours_beside_the_coverage_are_passed_over(shape):
    session = Fake(np.zeros((1, 3, 8, 8), np.float32), np.full(shape, 0.5, np.float32))
    found = OnnxMatting(session, "model.onnx")(np.zeros((8, 8, 3), np.uint8), Hints())
    np.testing.assert_allclose(found.alpha, 0.5)


@pytest.mark.parametrize(
    ("output", "words"),
    [
        (np.full((1, 1, 8, 8), 7.0), "from 7 to 7"),
        (np.full((1, 1, 8, 8), np.nan), "from nan"),
        (np.zeros((1, 3, 8, 8)), r"are \[1, 3, 8, 8\]"),
    ],
)
def test_what_is_no_coverage_is_refused(output, words):
    with pytest.raises(ForegroundError, match=words):
        OnnxMatting(Fake(output), "model.onnx")(np.zeros((8, 8, 3), np.uint8), Hints())


@pytest.mark.parametrize(
    "session", [Fake(inputs=2), Fake(inputs=0), Fake(shape=(1, 4, 8, 8)), Fake(shape=(3, 8, 8))]
)
def test_models_with_other_inputs_are_refused(session):
    with pytest.raises(ForegroundError, match="one input"):
        OnnxMatting(session, "model.onnx")


def test_a_file_that_is_no_model_and_one_that_is_not_there(tmp_path):
    (tmp_path / "bad.onnx").write_bytes(b"not a model")
    with pytest.raises(ForegroundError, match="Export the model again"):
        OnnxMatting.from_file(tmp_path / "bad.onnx")
    with pytest.raises(ForegroundError, match="no such file"):
        OnnxMatting.from_file(tmp_path / "absent.onnx")


def test_without_onnxruntime_the_command_that_installs_it_is_given(monkeypatch):
    real = builtins.__import__

    def without(name, *rest, **named):
        if name == "onnxruntime":
            raise ImportError("No module named 'onnxruntime'")
        return real(name, *rest, **named)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ForegroundError, match="pip install onnxruntime"):
        OnnxMatting.from_file("model.onnx")
