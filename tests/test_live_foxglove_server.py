"""The Foxglove server over real sockets: what viewers see, what operators send, what strangers may not."""

import base64
import contextlib
import json
import socket
import struct
import threading
import time

import numpy as np
import pytest
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from live_foxglove import Viewer
from live_helpers import live_image, update, wait_for
from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.sync.client import connect

from surecut.io import build
from surecut.io.live.access import Access, AccessError
from surecut.io.live.foxglove_server import FoxgloveServer
from surecut.io.live.interfaces import Command, Freeze, Pick, Reply, Reset, Save
from surecut.io.schemas import PIXEL_PICK, typestore

TOKEN = "a token of sixteen or more"
PICK = {"camera": "m_left", "point_id": "P1", "role": "cut", "u": 12.5, "v": 8, "stamp_ns": 7, "sigma_px": 1.5}


class Desk:
    def __init__(self) -> None:
        self.commands: list[Command] = []

    def __call__(self, command: Command) -> Reply:
        self.commands.append(command)
        return Reply(True, "queued")


@contextlib.contextmanager
def serving(access: Access | None = None, **options):
    desk = Desk()
    server = FoxgloveServer(access, 0, **options)
    server.start(desk)
    try:
        yield server, desk
    finally:
        server.stop()
        server.stop()


def cdr(type_name: str, payload: bytes):
    return typestore().deserialize_cdr(payload, type_name)


@pytest.mark.parametrize("subprotocol", ["foxglove.sdk.v1", "foxglove.websocket.v1"])
def test_a_viewer_sees_frames_ellipsoids_diagnostics_and_poses(subprotocol: str):
    with serving() as (server, _), Viewer(server.port, subprotocol) as viewer:
        server.publish(update(0))
        wait_for(lambda: len(viewer.channels()) >= 5)
        channels = viewer.channels()
        descriptors = FileDescriptorSet.FromString(base64.b64decode(channels["/tf"]["schema"]))
        assert any(m.name == "FrameTransforms" for file in descriptors.file for m in file.message_type)
        topics = ["/tf", "/surecut/points", "/diagnostics", "/surecut/pose/m", "/surecut/update"]
        viewer.subscribe(**{f"n{100 + i}": topic for i, topic in enumerate(topics)})
        wait_for(lambda: (server.publish(update(3)), len({n for n, _, _ in viewer.data}) == 5)[1])
        found = {topics[number - 100]: payload for number, _, payload in viewer.data}
        stamp = viewer.data[-1][1]
    assert stamp == update(3).stamp_ns
    frames = FrameTransforms.FromString(found["/tf"])
    assert {(t.parent_frame_id, t.child_frame_id) for t in frames.transforms} == {("o", "m"), ("o", "b")}
    assert [t.translation.x for t in frames.transforms if t.child_frame_id == "b"] == [0.5]
    scene = SceneUpdate.FromString(found["/surecut/points"])
    assert [entity.frame_id for entity in scene.entities] == ["b", "b"]
    sizes = scene.entities[0].spheres[0].size
    # diameters of the 95 % ellipsoid of sigmas 1, 2 and 3 mm
    assert sorted([sizes.x, sizes.y, sizes.z]) == pytest.approx([2 * 2.7955e-3 * k for k in (1, 2, 3)], rel=1e-4)
    assert scene.entities[0].cylinders[0].size.x == pytest.approx(0.1)
    assert "GO" in scene.entities[0].texts[0].text
    pose = cdr("geometry_msgs/msg/PoseWithCovarianceStamped", found["/surecut/pose/m"])
    assert np.asarray(pose.pose.covariance)[14] == pytest.approx(4e-4)  # pyright: ignore
    rows = cdr("diagnostic_msgs/msg/DiagnosticArray", found["/diagnostics"]).status  # pyright: ignore
    assert {row.name for row in rows} >= {"surecut: state", "surecut: point P1"}
    assert json.loads(found["/surecut/update"])["points"][0]["position_m"] == [0.1, 0.2, 4.5]


def test_marker_outlines_lie_on_the_image():
    with serving() as (server, _), Viewer(server.port) as viewer:
        server.image(live_image(0))
        wait_for(lambda: len(viewer.channels()) == 2)
        viewer.subscribe(n1="/m/left/image_raw", n2="/m/left/image_raw/annotations")
        wait_for(lambda: (server.image(live_image(9)), len({n for n, _, _ in viewer.data}) == 2)[1])
        found = {number: payload for number, _, payload in viewer.data}
    image = RawImage.FromString(found[1])
    assert (image.width, image.height, image.encoding, image.step) == (32, 24, "mono8", 32)
    assert image.data == live_image(9).pixels.tobytes()
    notes = ImageAnnotations.FromString(found[2])
    first = notes.points[0].points[0]
    # OpenCV's pixel 3 is centred at 3.5 from the image's edge
    assert (first.x, first.y) == (3.5, 9.5)
    assert {text.text for text in notes.texts} == {"f0/7", "f0/8", "P1"}
    assert (notes.circles[0].position.x, notes.circles[0].position.y) == (12.5, 8.5)


def test_commands_arrive_as_service_calls():
    with serving() as (server, desk), Viewer(server.port) as viewer:
        wait_for(lambda: viewer.of("advertiseServices"))
        services = {s["name"]: s["id"] for s in viewer.of("advertiseServices")[0]["services"]}
        viewer.call(services["/surecut/pick"], PICK, 41)
        viewer.call(services["/surecut/freeze"], {"frozen": False}, 42)
        viewer.call(services["/surecut/reset"], {}, 43)
        viewer.call(services["/surecut/save"], b"", 44)
        wait_for(lambda: len(viewer.replies) == 4)
        assert [call for _, call, _ in viewer.replies] == [41, 42, 43, 44]
        assert viewer.replies[0][2] == {"accepted": True, "text": "queued"}
    assert desk.commands == [Pick("m_left", "P1", "cut", (12.5, 8.0), 7, 1.5), Freeze(False), Reset(), Save()]
    assert server.counters()["commands"] == 4


def test_commands_arrive_as_messages():
    message = build.pixel_pick(5_000_000_009, "b_rgb", "P2", "grasp", (3.0, 4.0), 2.0)
    ros = bytes(typestore().serialize_cdr(message, PIXEL_PICK))
    with serving() as (server, desk), Viewer(server.port) as viewer:
        channels = [
            {"id": 1, "topic": "/surecut/command", "encoding": "json", "schemaName": ""},
            {"id": 2, "topic": "/picks", "encoding": "cdr", "schemaName": PIXEL_PICK},
        ]
        viewer.send(op="advertise", channels=channels)
        viewer.connection.send(struct.pack("<BI", 1, 1) + json.dumps({"command": "pick", **PICK}).encode())
        viewer.connection.send(struct.pack("<BI", 1, 2) + ros)
        wait_for(lambda: len(desk.commands) == 2)
    assert desk.commands[1] == Pick("b_rgb", "P2", "grasp", (3.0, 4.0), 5_000_000_009, 2.0)


def test_without_the_token_nothing_is_changed():
    with serving(Access(token=TOKEN)) as (server, desk), Viewer(server.port) as viewer:
        viewer.call(1, PICK)
        viewer.call(1, {**PICK, "token": TOKEN[:-1]})
        viewer.call(1, {**PICK, "token": ["x"]})
        wait_for(lambda: len(viewer.of("serviceCallFailure")) == 3)
        assert desk.commands == []
        viewer.call(1, {**PICK, "token": TOKEN})
        wait_for(lambda: len(desk.commands) == 1)
        assert server.counters()["unauthorised"] == 3
        for _ in range(3):
            with contextlib.suppress(ConnectionClosed):
                viewer.call(2, {"token": "guess"})
        wait_for(lambda: viewer.connection.close_code == 1008)
    assert len(desk.commands) == 1


def test_another_address_is_refused_unless_allowed():
    with pytest.raises(AccessError, match="other machines"):
        FoxgloveServer(Access("0.0.0.0"), 0)
    with pytest.raises(AccessError, match="at least 16"):
        Access(token="short")
    # allowed, but without a token: to look at, not to change
    with serving(Access("0.0.0.0", allow_remote=True)) as (server, desk), Viewer(server.port) as viewer:
        wait_for(lambda: viewer.of("serverInfo"))
        assert viewer.of("serverInfo")[0]["capabilities"] == []
        viewer.call(2, {})
        wait_for(lambda: server.counters().get("unauthorised"))
        assert desk.commands == []


@pytest.mark.parametrize(
    ("origin", "welcome"),
    [
        ("https://app.foxglove.dev", True),
        ("http://localhost:8080", True),
        ("https://evil.example", False),
        ("http://localhost.evil.example", False),
        ("null", False),
    ],
)
def test_web_pages_of_strangers_cannot_connect(origin: str, welcome: bool):
    with serving() as (server, _):
        if welcome:
            with Viewer(server.port, origin=origin) as viewer:
                wait_for(lambda: viewer.of("serverInfo"))
        else:
            with pytest.raises(InvalidHandshake):
                Viewer(server.port, origin=origin)


NONSENSE = [
    "no json",
    "[1, 2]",
    "null",
    '{"op": "fetchAsset"}',
    '{"op": ["x"]}',
    '{"op": "subscribe"}',
    '{"op": "subscribe", "subscriptions": 5}',
    '{"op": "subscribe", "subscriptions": [{"id": -1, "channelId": 1e99}]}',
    '{"op": "subscribe", "subscriptions": [null]}',
    '{"op": "unsubscribe", "subscriptionIds": ["x"]}',
    '{"op": "advertise", "channels": [{}]}',
    "[" * 20_000,
    b"",
    b"\x01",
    b"\x01\x05\x00\x00\x00{}",
    b"\x02",
    struct.pack("<BIII", 2, 99, 1, 4) + b"json{}",
    struct.pack("<BIII", 2, 1, 1, 0xFFFFFFFF) + b"json{}",
    b"\xff" * 100,
    struct.pack("<BIII", 2, 1, 1, 4) + b"json" + b"\xff\xfe",
    struct.pack("<BIII", 2, 1, 1, 4) + b'json{"camera": "m_left", "point_id": "../x"}',
    struct.pack("<BIII", 2, 1, 1, 4) + b'json{"camera":"m_left","point_id":"P","u":NaN,"v":1}',
    struct.pack("<BIII", 2, 1, 1, 4) + b'json{"camera":"m_left","point_id":"P","u":1' + b"0" * 400 + b',"v":1}',
    struct.pack("<BIII", 2, 1, 1, 4) + b'json{"camera":"m_left","point_id":"P","u":true,"v":1}',
    struct.pack("<BIII", 2, 1, 1, 4) + b'json{"camera":"m_left","point_id":"P","u":1,"v":1,"extra":1}',
    struct.pack("<BIII", 2, 3, 1, 4) + b'json{"frozen": "yes"}',
    struct.pack("<BIII", 2, 1, 1, 4) + b"json" + b" " * 5000,
]


@pytest.mark.parametrize("frame", NONSENSE, ids=range(len(NONSENSE)))
def test_nonsense_is_counted_and_changes_nothing(frame):
    with serving() as (server, desk), Viewer(server.port) as viewer:
        viewer.connection.send(frame)
        wait_for(lambda: server.counters().get("malformed", 0) == 1)
        viewer.call(2, {})
        wait_for(lambda: desk.commands == [Reset()])
        assert server.counters()["clients"] == 1


def test_a_frame_that_is_too_large_ends_the_connection_only():
    with serving() as (server, _), Viewer(server.port) as other:
        with Viewer(server.port) as viewer, contextlib.suppress(ConnectionClosed):
            viewer.connection.send(b"\x01" * (1 << 20))
            wait_for(lambda: viewer.connection.close_code == 1009)
        wait_for(lambda: server.counters().get("oversized", 0) == 1)
        server.publish(update())
        wait_for(other.channels)


def test_bytes_that_are_no_text_end_the_connection_only():
    with serving() as (server, _), Viewer(server.port) as other:
        with socket.create_connection(("127.0.0.1", server.port)) as raw:
            key = base64.b64encode(b"0" * 16).decode()
            raw.sendall(
                f"GET / HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
                f"Sec-WebSocket-Key: {key}\r\n"
                "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n".encode()
            )
            wait_for(lambda: server.counters()["clients"] == 2)
            raw.sendall(b"\x81\x84\x00\x00\x00\x00\xff\xfe\xfd\xfc")
            wait_for(lambda: server.counters()["clients"] == 1)
        server.publish(update())
        wait_for(other.channels)
        assert server.counters()["malformed"] == 1


def test_a_stalled_viewer_loses_the_oldest_and_holds_up_nobody():
    with serving(client_bytes=300_000) as (server, _), Viewer(server.port) as lively:
        with connect(
            f"ws://127.0.0.1:{server.port}",
            subprotocols=["foxglove.sdk.v1"],
            compression=None,
            proxy=None,
            max_queue=1,
            close_timeout=0.1,
        ) as stalled:
            big = live_image(0)
            server.image(type(big)("/i", 1, "m_left", np.zeros((300, 400), np.uint8)))
            wait_for(lambda: lively.channels())
            lively.subscribe(n1="/i")
            stalled.send(json.dumps({"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 1}]}))
            longest = 0.0
            for number in range(100):
                begun = time.monotonic()
                server.image(type(big)("/i", number + 1, "m_left", np.zeros((300, 400), np.uint8)))
                longest = max(longest, time.monotonic() - begun)
                time.sleep(0.005)
            wait_for(lambda: lively.data and lively.data[-1][1] == 100)
            assert longest < 1.0
            assert server.counters()["dropped"] > 10
            assert len(lively.data) > 50


def test_more_viewers_than_allowed_are_turned_away():
    with serving(maximum_clients=2) as (server, _), Viewer(server.port) as one, Viewer(server.port):
        with contextlib.suppress(ConnectionClosed, InvalidHandshake, OSError), Viewer(server.port) as third:
            wait_for(lambda: third.connection.close_code == 1013)
        # a flood of connections that never say anything
        flood = [socket.create_connection(("127.0.0.1", server.port)) for _ in range(30)]
        wait_for(lambda: server.counters().get("refused_connections", 0) >= 25)
        server.publish(update())
        wait_for(one.channels)
        for connection in flood:
            connection.close()


def test_a_thousand_malformed_messages_a_second_do_not_stop_the_poses():
    """For a second; the poses keep coming at 50 Hz."""
    stop = threading.Event()
    sent = 0

    def spam(port: int) -> None:
        nonlocal sent
        with connect(
            f"ws://127.0.0.1:{port}", subprotocols=["foxglove.sdk.v1"], compression=None, proxy=None, close_timeout=0.1
        ) as connection:
            begun = time.monotonic()
            while not stop.is_set():
                connection.send(NONSENSE[sent % 11])
                sent += 1
                time.sleep(max(0.0, begun + sent / 1000 - time.monotonic()))

    with serving() as (server, _), Viewer(server.port) as viewer:
        server.publish(update())
        wait_for(lambda: "/tf" in viewer.channels())
        viewer.subscribe(n1="/tf")
        thread = threading.Thread(target=spam, args=(server.port,))
        thread.start()
        for number in range(50):
            server.publish(update(number))
            time.sleep(0.02)
        stop.set()
        thread.join(5)
        wait_for(lambda: viewer.data and viewer.data[-1][1] == update(49).stamp_ns)
        wait_for(lambda: server.counters()["malformed"] == sent)
        assert sent > 300
        assert len({stamp for _, stamp, _ in viewer.data}) >= 48


def test_a_port_in_use_is_told():
    with serving() as (server, _), pytest.raises(AccessError, match="cannot listen"):
        FoxgloveServer(None, server.port).start()
