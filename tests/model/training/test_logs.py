"""Logs can be read by others, and go on where the run does."""

import json
import struct

import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

from preface.artifacts import ArtifactError
from preface.model.training.event_file import EventFile
from preface.model.training.logs import RunLog, read_log
from preface.model.training.schedule import LogLinear

FIELD = descriptor_pb2.FieldDescriptorProto
# tensorflow/core/util/event.proto and framework/summary.proto, as far as they are used.
MESSAGES = {
    "Image": [
        ("height", 1, "INT32"),
        ("width", 2, "INT32"),
        ("colorspace", 3, "INT32"),
        ("encoded", 4, "BYTES"),
    ],
    "Value": [("tag", 1, "STRING"), ("simple_value", 2, "FLOAT"), ("image", 4, "Image")],
    "Summary": [("value", 1, "*Value")],
    "SessionLog": [("status", 1, "INT32")],
    "Event": [
        ("wall_time", 1, "DOUBLE"),
        ("step", 2, "INT64"),
        ("file_version", 3, "STRING"),
        ("summary", 5, "Summary"),
        ("session_log", 7, "SessionLog"),
    ],
}


@pytest.fixture(scope="module")
def event_type():
    """The message type, made by Google's library."""
    file = descriptor_pb2.FileDescriptorProto(name="events.proto", package="t", syntax="proto3")
    for name, members in MESSAGES.items():
        message = file.message_type.add(name=name)
        for field, number, kind in members:
            label = FIELD.LABEL_REPEATED if kind.startswith("*") else FIELD.LABEL_OPTIONAL
            kind = kind.lstrip("*")
            if kind in MESSAGES:
                message.field.add(
                    name=field, number=number, type=FIELD.TYPE_MESSAGE, type_name=f".t.{kind}", label=label
                )
            else:
                message.field.add(name=field, number=number, type=getattr(FIELD, f"TYPE_{kind}"), label=label)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("t.Event"))


def crc32c(data):
    """CRC-32C by its definition, bit by bit."""
    crc = 0xFFFFFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0x82F63B78 if crc & 1 else 0)
    return crc ^ 0xFFFFFFFF


def masked(data):
    crc = crc32c(data)
    return ((crc >> 15 | crc << 17) + 0xA282EAD8) % 2**32


def events(path, event_type):
    data, found = path.read_bytes(), []
    while data:
        (length, crc) = struct.unpack("<QI", data[:12])
        assert crc == masked(data[:8])
        body = data[12 : 12 + length]
        assert struct.unpack("<I", data[12 + length : 16 + length])[0] == masked(body)
        found.append(event_type.FromString(body))
        data = data[16 + length :]
    return found


def test_event_files_are_what_tensorboard_reads(tmp_path, event_type):
    with EventFile(tmp_path, 300) as file:
        file.numbers(301, {"train/loss": 0.1, "train/psnr": -1e30})
        file.picture(2**40, "views", b"\x89PNG" + bytes(300), (640, 480))
    version, session, numbers, picture = events(file.path, event_type)
    assert version.file_version == "brain.Event:2"
    assert version.wall_time > 1.6e9
    assert (session.step, session.session_log.status) == (300, 1)
    values = {value.tag: value.simple_value for value in numbers.summary.value}
    assert values == {"train/loss": pytest.approx(0.1), "train/psnr": pytest.approx(-1e30)}
    assert numbers.step == 301
    assert picture.step == 2**40
    image = picture.summary.value[0].image
    assert (image.width, image.height, image.colorspace) == (640, 480, 3)
    assert image.encoded == b"\x89PNG" + bytes(300)
    assert ".tfevents." in file.path.name


def test_a_log_goes_on_behind_the_checkpoint(tmp_path, event_type):
    with RunLog(tmp_path, 0) as log:
        for step in (10, 20, 30):
            log.write(step, "train", {"loss": step / 2, "rate": {"nerf": 0.5}})
    with (tmp_path / "log.jsonl").open("a") as file:
        file.write('{"step": 40, "kind": "tr')  # cut off by a crash
    with RunLog(tmp_path, 20) as log:
        log.write(30, "train", {"loss": 1.0})
        log.write(30, "validation", {"psnr": 20.0})
    entries = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert [(e["step"], e["kind"]) for e in entries] == [
        (10, "train"),
        (20, "train"),
        (30, "train"),
        (30, "validation"),
    ]
    assert [e["loss"] for e in read_log(tmp_path / "log.jsonl", "train")] == [5, 10, 1]
    first, second = sorted((tmp_path / "events").iterdir())
    tags = {value.tag for event in events(first, event_type) for value in event.summary.value}
    assert tags == {"train/loss", "train/rate/nerf"}
    assert events(second, event_type)[1].step == 20


def test_a_file_that_is_no_log_is_not_overwritten(tmp_path):
    (tmp_path / "log.jsonl").write_text("notes of mine\n")
    with pytest.raises(ArtifactError, match=r"log.jsonl: .*Move the file away"):
        RunLog(tmp_path, 5)
    assert (tmp_path / "log.jsonl").read_text() == "notes of mine\n"


def test_rates_fall_by_the_same_factor_at_each_step():
    rate = LogLinear(2e-3, 2e-5, 1_000_000)
    assert rate(0) == pytest.approx(2e-3, rel=1e-12)
    assert rate(1_000_000) == pytest.approx(2e-5, rel=1e-12)
    assert rate(500_000) == pytest.approx(2e-4, rel=1e-12)
    assert rate(1_500_000) == pytest.approx(2e-5, rel=1e-12)
    factors = [rate(step + 1) / rate(step) for step in (0, 1000, 999_999)]
    assert factors == pytest.approx([0.01 ** (1 / 1_000_000)] * 3, rel=1e-12)


def test_a_warm_up_rises_to_the_schedule():
    warm, plain = LogLinear(1e-2, 9e-3, 100, warmup=10), LogLinear(1e-2, 9e-3, 100)
    assert warm(0) == pytest.approx(1e-4)
    assert all(warm(step) < warm(step + 1) for step in range(8))
    assert [warm(step) for step in range(10, 100)] == [plain(step) for step in range(10, 100)]


@pytest.mark.parametrize(
    ("first", "last"), [(0.0, 1e-3), (1e-3, -1.0), (float("nan"), 1e-3), (1e-3, float("inf"))]
)
def test_rates_that_cannot_be_are_refused(first, last):
    with pytest.raises(ValueError, match="learning rate"):
        LogLinear(first, last, 10)


@pytest.mark.parametrize(
    ("value", "written"),
    [
        (1e39, 2**128 - 2**104),
        (-1e300, 2**104 - 2**128),
        (1e-60, 0),
        (float("inf"), float("inf")),
        (2.5, 2.5),
    ],
)
def test_numbers_beyond_float32_are_its_largest(tmp_path, event_type, value, written):
    with EventFile(tmp_path, 0) as file:
        file.numbers(3, {"train/gradient_norm/nerf": value})
    assert events(file.path, event_type)[-1].summary.value[0].simple_value == written


def test_a_huge_gradient_does_not_end_a_run(tmp_path):
    with RunLog(tmp_path, 0) as log:
        log.write(1, "train", {"loss": 0.5, "gradient_norm": {"nerf": 1e39}})
    assert read_log(tmp_path / "log.jsonl", "train")[0]["gradient_norm"] == {"nerf": 1e39}
