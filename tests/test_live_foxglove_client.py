"""The Foxglove client against a small server of ours, and against Foxglove's own."""

import base64
import json
import struct
import time

import logmaker
import pytest
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.timestamp_pb2 import Timestamp
from live_foxglove import Robot
from live_helpers import Collector, free_port, wait_for
from mcap_protobuf.schema import build_file_descriptor_set

from surecut.factors.errors import LogError
from surecut.factors.rig import Rig
from surecut.io.live.admission import Limits
from surecut.io.live.expected import expected_bodies
from surecut.io.live.foxglove_client import FoxgloveClient
from surecut.io.messages import ImageBody, PickBody
from surecut.io.schemas import schema, typestore

PICK, IMAGE = "surecut_msgs/msg/PixelPick", "sensor_msgs/msg/Image"
RIG = Rig.model_validate(
    {
        "version": 1,
        "boards": [{"id": "f0", "markers": [{"id": 7, "centre_m": [0, 0]}]}],
        "mount": {"board": "f0", "f_T_b": {}},
    }
)


def ros_channel(number: int, topic: str, type_name: str) -> dict:
    text = schema(type_name).text
    return {
        "id": number,
        "topic": topic,
        "encoding": "cdr",
        "schemaName": type_name,
        "schema": text,
        "schemaEncoding": "ros2msg",
    }


def message(topic: str, number: int = 0) -> bytes:
    type_name, value = next((kind, value) for at, kind, value in logmaker.messages(number) if at == topic)
    return bytes(typestore().serialize_cdr(value, type_name))


def raw_image() -> RawImage:
    image = RawImage(frame_id="m_left", width=4, height=2, encoding="mono8", step=4, data=bytes(range(8)))
    image.timestamp.CopyFrom(Timestamp(seconds=1000))
    return image


def client(port: int, **options) -> tuple[FoxgloveClient, Collector]:
    source, found = FoxgloveClient(f"ws://127.0.0.1:{port}", clock=lambda: 99, **options), Collector()
    source.start(found)
    return source, found


def test_wanted_channels_are_subscribed_and_decoded():
    protobuf = build_file_descriptor_set(RawImage).SerializeToString()
    channels = [
        ros_channel(1, "/picks", PICK),
        ros_channel(2, "/m/left/image_raw", IMAGE),
        ros_channel(3, "/unasked", IMAGE),
        {
            "id": 4,
            "topic": "/m/right/image_raw",
            "encoding": "protobuf",
            "schemaName": "foxglove.RawImage",
            "schema": base64.b64encode(protobuf).decode(),
        },
    ]
    with Robot(channels) as robot:
        source, found = client(robot.port, expected=expected_bodies(RIG))
        wait_for(lambda: set(robot.subscribed) == {1, 2, 4})
        robot.publish(1, message("/picks"))
        robot.publish(2, message("/m/left/image_raw"))
        robot.publish(4, raw_image().SerializeToString(), 1_000_000_000_000)
        wait_for(lambda: len(found.messages) == 3)
        assert source.connected()
        source.stop()
    assert [type(m.body) for m in found.messages] == [PickBody, ImageBody, ImageBody]
    assert {m.log_time_ns for m in found.messages} == {99}
    assert found.messages[2].stamp_ns == 1_000_000_000_000
    assert source.counters() == {"received": 3, "delivered": 3}


HOSTILE = [
    "text where bytes belong",
    '{"op": "advertise"}',
    '{"op": "advertise", "channels": [7]}',
    '{"op": "advertise", "channels": [{"id": "x", "topic": "/picks"}]}',
    '{"op": "advertise", "channels": [{"id": 1e300, "topic": "/picks"}]}',
    "[" * 100_000,
    b"",
    b"\x01\x02",
    struct.pack("<BIQ", 1, 4711, 0),
    struct.pack("<BIQ", 1, 1, 0),
    struct.pack("<BIQ", 1, 1, 0) + b"\x00\x01\x00\x00" + b"\xff" * 40,
]


@pytest.mark.parametrize("frame", HOSTILE, ids=range(len(HOSTILE)))
def test_a_hostile_server_is_counted(frame):
    with Robot([ros_channel(1, "/picks", PICK)]) as robot:
        source, found = client(robot.port)
        wait_for(lambda: robot.subscribed)
        robot.raw(frame)
        robot.publish(1, message("/picks"))
        wait_for(lambda: found.messages)
        source.stop()
    assert source.counters()["malformed"] == 1
    assert source.counters()["delivered"] == 1


def test_bad_text_and_too_large_messages_cost_the_connection_and_it_comes_back():
    with Robot([ros_channel(1, "/picks", PICK)]) as robot:
        source, found = client(robot.port, limits=Limits(message_bytes=100_000))
        for number, bad in enumerate([b"\x01" * 200_000, None], start=1):
            wait_for(lambda n=number: len(robot.connections) == n and robot.subscribed)
            time.sleep(0.05)
            if bad is None:
                robot.connections[-1].send(b"\xff\xfe", text=True)
            else:
                robot.raw(bad)
        wait_for(lambda: len(robot.connections) == 3)
        time.sleep(0.1)
        robot.publish(1, message("/picks"))
        wait_for(lambda: found.messages)
        source.stop()
    counters = source.counters()
    assert (counters["oversized"], counters["malformed"], counters["reconnects"]) == (1, 1, 2)


def test_a_server_that_goes_and_comes_is_found_again():
    port = free_port()
    source, found = client(port)
    wait_for(lambda: "cannot connect" in source.status())
    for _ in range(2):
        with Robot([ros_channel(1, "/picks", PICK)], port) as robot:
            wait_for(lambda r=robot: r.subscribed)
            before = len(found.messages)
            robot.publish(1, message("/picks"))
            wait_for(lambda b=before: len(found.messages) > b)
        wait_for(lambda: not source.connected())
    begun = time.monotonic()
    source.stop()
    assert time.monotonic() - begun < 5
    assert source.ended()


def test_an_image_is_asked_for_in_one_form():
    zipped = "sensor_msgs/msg/CompressedImage"
    channels = [
        ros_channel(1, "/m/left/image_raw/compressed", zipped),
        ros_channel(2, "/m/left/image_raw", IMAGE),
        ros_channel(3, "/m/right/image_raw/compressed", zipped),
    ]
    with Robot(channels) as robot:
        source, _ = client(robot.port, expected=expected_bodies(RIG))
        wait_for(lambda: set(robot.subscribed) == {2, 3})
        source.stop()


def test_a_type_that_nobody_needs_is_not_asked_for():
    other = {"id": 1, "topic": "/tf", "encoding": "cdr", "schemaName": "tf2_msgs/msg/TFMessage", "schema": ""}
    strange = {**ros_channel(2, "/picks", PICK), "schema": "float64 something_else"}
    with Robot([other, strange, ros_channel(3, "/picks", PICK)]) as robot:
        source, _ = client(robot.port)
        wait_for(lambda: 3 in robot.subscribed)
        source.stop()
        assert set(robot.subscribed) == {3}
    assert source.counters() == {"unknown_type": 1, "unknown_encoding": 1}


def test_the_definition_of_a_stranger_is_never_compiled(monkeypatch):
    """Code generated from a text that came over the network would be a way in."""
    evil = {**ros_channel(2, "/picks", PICK), "schema": "std_msgs/Header header\nfloat64[1000000000] huge"}
    with Robot([evil, ros_channel(3, "/picks", PICK)]) as robot:
        begun = time.monotonic()
        source, _ = client(robot.port)
        wait_for(lambda: 3 in robot.subscribed)
        source.stop()
        assert time.monotonic() - begun < 20
    assert source.counters()["unknown_encoding"] == 1


def test_foxgloves_own_server():
    """Its SDK's server, which speaks `foxglove.sdk.v1` only."""
    foxglove = pytest.importorskip("foxglove")
    context = foxglove.Context()
    server = foxglove.start_server(port=0, context=context)
    try:
        made = foxglove.Schema(name=PICK, encoding="ros2msg", data=schema(PICK).text.encode())
        channel = foxglove.Channel("/picks", message_encoding="cdr", schema=made, context=context)
        source, found = client(server.port, expected=expected_bodies(RIG))
        wait_for(lambda: (channel.log(message("/picks")), time.sleep(0.02), found.messages)[2])
        source.stop()
    finally:
        server.stop()
    body = found.messages[0].body
    assert isinstance(body, PickBody)
    assert (body.point_id, body.px.tolist()) == ("P1", [30.5, 20.25])


@pytest.mark.parametrize("url", ["http://x", "ws://", "robot:8765", ""])
def test_addresses_are_checked(url: str):
    with pytest.raises(LogError, match="no address"):
        FoxgloveClient(url)


def test_json_images_are_read_too():
    text = json.dumps(
        {
            "timestamp": {"sec": 5, "nsec": 6},
            "frame_id": "m_left",
            "width": 4,
            "height": 2,
            "step": 4,
            "encoding": "mono8",
            "data": base64.b64encode(bytes(8)).decode(),
        }
    )
    channel = {"id": 9, "topic": "/m/left/image_raw", "encoding": "json", "schemaName": "foxglove.RawImage"}
    with Robot([channel]) as robot:
        source, found = client(robot.port)
        wait_for(lambda: robot.subscribed)
        robot.publish(9, text.encode(), 5_000_000_000)
        wait_for(lambda: found.messages)
        source.stop()
    assert found.messages[0].stamp_ns == 5_000_000_006
