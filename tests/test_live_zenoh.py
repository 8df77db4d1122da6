"""ROS 2 over zenoh, as rmw_zenoh speaks it, through a router on this machine."""

import contextlib
import json
import struct
import time

import logmaker
import pytest
import zenoh
from live_helpers import Collector, free_port, update, wait_for

from surecut.factors.errors import LogError
from surecut.io.live.admission import Limits
from surecut.io.live.zenoh_link import Attachment, channel_of, key_of, read_attachment
from surecut.io.live.zenoh_sink import ZenohSink
from surecut.io.live.zenoh_source import ZenohSource
from surecut.io.messages import CameraInfoBody, ImageBody, PickBody
from surecut.io.schemas import typestore

EXPECTED = {"/picks": (PickBody,), "/m/left/image_raw": (ImageBody,), "/m/left/camera_info": (CameraInfoBody,)}
PICK, IMAGE = "surecut_msgs/msg/PixelPick", "sensor_msgs/msg/Image"


def node(mode: str, **endpoints: str) -> zenoh.Session:
    config = zenoh.Config()
    config.insert_json5("mode", json.dumps(mode))
    config.insert_json5("scouting/multicast/enabled", "false")
    for name in ("listen", "connect"):
        config.insert_json5(f"{name}/endpoints", json.dumps([endpoints[name]] if name in endpoints else []))
    return zenoh.open(config)


@contextlib.contextmanager
def router(port: int):
    session = node("router", listen=f"tcp/127.0.0.1:{port}")
    try:
        yield session
    finally:
        session.close()


@contextlib.contextmanager
def started(port: int, **options):
    source, found = ZenohSource(EXPECTED, f"tcp/127.0.0.1:{port}", clock=lambda: 77, **options), Collector()
    source.start(found)
    try:
        yield source, found
    finally:
        source.stop()


def payload(topic: str, number: int = 0) -> bytes:
    type_name, value = next((kind, value) for at, kind, value in logmaker.messages(number) if at == topic)
    return bytes(typestore().serialize_cdr(value, type_name))


def note(number: int = 1, gid: bytes = b"g" * 16) -> bytes:
    return Attachment(number, logmaker.START_NS, gid).encode()


def put(session: zenoh.Session, key: str, data: bytes, attachment: bytes | None = None) -> None:
    """Without loss, which is not zenoh's default."""
    session.put(key, data, attachment=attachment, congestion_control=zenoh.CongestionControl.BLOCK)


def put_until(session: zenoh.Session, key: str, data: bytes, done, attachment: bytes | None = None) -> None:
    """Discovery takes its time."""
    wait_for(lambda: (put(session, key, data, attachment or note()), time.sleep(0.02), done())[2])


def test_keys_and_attachments_are_those_of_rmw_zenoh():
    key = key_of(0, "/m/left/image_raw", IMAGE)
    head, kind, digest = key.rsplit("/", 2)
    assert (head, kind) == ("0/m/left/image_raw", "sensor_msgs::msg::dds_::Image_")
    assert digest.startswith("RIHS01_")
    assert len(digest) == 7 + 64
    assert channel_of("/x", key).schema_name == IMAGE
    data = Attachment(5, 6, b"0123456789abcdef").encode()
    assert len(data) == 33
    assert struct.unpack("<qqB16s", data) == (5, 6, 16, b"0123456789abcdef")
    assert read_attachment(data) == Attachment(5, 6, b"0123456789abcdef")
    assert read_attachment(data[:-1]) is None


@pytest.mark.parametrize(
    ("key", "match"),
    [
        ("0/x", "names no"),
        ("0/x/sensor_msgs__Image/h", "names no"),
        (key_of(0, "/x", IMAGE)[:-4] + "0000", "another one"),
        ("0/x/std_msgs::msg::dds_::String_;import os/h", "names no"),
    ],
)
def test_keys_of_others_are_told(key: str, match: str):
    with pytest.raises(LogError, match=match):
        channel_of("/x", key)


def test_messages_of_a_robot_arrive():
    port = free_port()
    with router(port), started(port) as (source, found), node("client", connect=f"tcp/127.0.0.1:{port}") as robot:
        put_until(robot, key_of(0, "/picks", PICK), payload("/picks"), lambda: found.messages)
        image_key = key_of(0, "/m/left/image_raw", IMAGE)
        put(robot, image_key, payload("/m/left/image_raw"), attachment=note())
        # robots before Iron have no hash
        put(
            robot,
            image_key.rsplit("/", 1)[0] + "/TypeHashNotSupported",
            payload("/m/left/image_raw", 1),
            attachment=note(),
        )
        wait_for(lambda: found.topics()["/m/left/image_raw"] == 2)
        assert source.connected()
        assert {m.log_time_ns for m in found.messages} == {77}
        body = found.messages[0].body
        assert isinstance(body, PickBody)
        assert body.px.tolist() == [30.5, 20.25]


def test_the_robot_is_told_who_listens():
    """Publishers of images send only to those whom ROS 2's graph knows."""
    port = free_port()
    with router(port), node("client", connect=f"tcp/127.0.0.1:{port}") as robot:
        with started(port) as (source, _):
            wait_for(source.connected)
            tokens: list[str] = []

            def all_there() -> bool:
                replies = robot.liveliness().get("@ros2_lv/0/**")
                tokens[:] = [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]
                return len(tokens) == 4

            wait_for(all_there)
            kinds = sorted(token.split("/")[5] for token in tokens)
            assert kinds == ["MS", "MS", "MS", "NN"]
            digest = key_of(0, "/m/left/image_raw", IMAGE).rsplit("/", 1)[1]
            expected = f"surecut/%m%left%image_raw/sensor_msgs::msg::dds_::Image_/{digest}/::,1:,:,:,,"
            assert any(token.endswith(expected) for token in tokens)


def test_what_is_no_message_is_counted():
    port = free_port()
    limits = Limits(message_bytes=50_000)
    with (
        router(port),
        started(port, limits=limits) as (source, found),
        node("client", connect=f"tcp/127.0.0.1:{port}") as robot,
    ):
        key = key_of(0, "/picks", PICK)
        put_until(robot, key, payload("/picks"), lambda: found.messages)
        put(robot, key, b"\x00\x01\x00\x00garbage", attachment=note())
        put(robot, key, b"", attachment=b"short")
        put(robot, key, bytes(60_000))
        put(robot, key_of(0, "/picks", IMAGE), payload("/m/left/image_raw"), attachment=note())
        put(robot, "0/picks/no/type", b"x")
        put(robot, key[:-3] + "000", payload("/picks"), attachment=note())
        expected = {"malformed": 2, "oversized": 1, "wrong_type": 1, "unknown_encoding": 2}
        wait_for(lambda: {name: source.counters().get(name) for name in expected} == expected)


def test_two_publishers_of_one_image_topic_are_told_apart():
    port = free_port()
    with router(port), started(port) as (source, found), node("client", connect=f"tcp/127.0.0.1:{port}") as robot:
        key = key_of(0, "/m/left/image_raw", IMAGE)
        put_until(robot, key, payload("/m/left/image_raw"), lambda: found.messages, note(gid=b"a" * 16))
        for number in range(3):
            put(robot, key, payload("/m/left/image_raw", number), attachment=note(gid=b"b" * 16))
        wait_for(lambda: source.counters().get("other_publisher") == 3)


def test_a_slow_receiver_never_holds_up_the_robot():
    port = free_port()
    with router(port), node("client", connect=f"tcp/127.0.0.1:{port}") as robot:
        source = ZenohSource(EXPECTED, f"tcp/127.0.0.1:{port}", maximum_bytes=200_000)
        found = Collector()

        def slow(message):
            found(message)
            time.sleep(0.05)

        source.start(slow)
        key, data = key_of(0, "/m/left/image_raw", IMAGE), payload("/m/left/image_raw")
        put_until(robot, key, data, lambda: found.messages)
        longest = 0.0
        publisher = robot.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)
        for _ in range(400):
            begun = time.monotonic()
            publisher.put(data, attachment=note())
            longest = max(longest, time.monotonic() - begun)
        wait_for(lambda: source.counters().get("dropped", 0) > 100)
        assert longest < 3.0
        assert set(source.by_topic()["dropped"]) == {"/m/left/image_raw"}
        source.stop()


def test_a_router_that_comes_later_and_goes_and_comes_is_found():
    port = free_port()
    with started(port) as (source, found):
        wait_for(lambda: "cannot be reached" in source.status())
        for _ in range(2):
            before = len(found.messages)
            with router(port), node("client", connect=f"tcp/127.0.0.1:{port}") as robot:
                key = key_of(0, "/picks", PICK)
                put_until(robot, key, payload("/picks"), lambda b=before: len(found.messages) > b)
            wait_for(lambda: not source.connected())
        assert "gone" in source.status()


def test_the_estimate_goes_back_to_the_robot():
    port = free_port()
    sink = ZenohSink(f"tcp/127.0.0.1:{port}")
    sink.start()
    sink.publish(update(0))
    wait_for(lambda: sink.counters().get("dropped") == 1)
    found: dict[str, tuple[bytes, bytes]] = {}

    def keep(sample: zenoh.Sample) -> None:
        attachment = sample.attachment
        found[str(sample.key_expr)] = (sample.payload.to_bytes(), attachment.to_bytes() if attachment else b"")

    with router(port), node("client", connect=f"tcp/127.0.0.1:{port}") as robot:
        robot.declare_subscriber("0/**", keep)
        wait_for(lambda: (sink.publish(update(5)), time.sleep(0.05), len(found) >= 6)[2])
        tokens = [str(reply.ok.key_expr) for reply in robot.liveliness().get("@ros2_lv/**") if reply.ok is not None]
        data, attachment = found[key_of(0, "/estimate/points", "surecut_msgs/msg/PointWithCovarianceArray")]
        begun = time.monotonic()
        sink.stop()
        assert time.monotonic() - begun < 3
    points = typestore().deserialize_cdr(data, "surecut_msgs/msg/PointWithCovarianceArray")
    assert points.points[0].z == 6.5  # pyright: ignore
    read = read_attachment(attachment)
    assert read is not None
    assert read.sequence >= 1
    assert any(token.endswith("/0/0/NN/%/%/surecut") for token in tokens)
    assert any(
        "%estimate%points/surecut_msgs::msg::dds_::PointWithCovarianceArray_/RIHS01_" in token for token in tokens
    )


@pytest.mark.parametrize("router_address", ["localhost:7447", "tcp://localhost:7447", "", "udp/x"])
def test_addresses_are_checked(router_address: str):
    with pytest.raises(LogError, match="no address"):
        ZenohSource(EXPECTED, router_address)
