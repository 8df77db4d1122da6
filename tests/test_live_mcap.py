"""MCAP as a stream over TCP and standard input: cut, corrupt, endless, too large."""

import io
import socket
import struct
import subprocess
import sys
import threading
import time

import logmaker
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from live_helpers import Collector, free_port, tcp_server, wait_for

from surecut.factors.errors import LogError
from surecut.io.damage import Damage
from surecut.io.live.admission import Limits
from surecut.io.live.mcap_stream import McapStream, tcp_target
from surecut.io.records import RecordStream, Untrusted


def recording(moments: int = 5, chunk_size: int | None = None) -> bytes:
    target = io.BytesIO()
    logmaker.write_log(target, moments, chunk_size=chunk_size)
    return target.getvalue()


def in_pieces(connection: socket.socket, data: bytes, size: int = 5000) -> None:
    for start in range(0, len(data), size):
        connection.sendall(data[start : start + size])


def test_messages_arrive_with_the_time_of_receipt():
    data = recording()
    found = Collector()
    with tcp_server(lambda c, _: in_pieces(c, data)) as port:
        source = McapStream(f"tcp://127.0.0.1:{port}", clock=lambda: 42)
        source.start(found)
        wait_for(lambda: found.topics().get("/m/left/markers", 0) >= 5)
        source.stop()
    assert found.topics()["/m/left/image_raw"] >= 5
    assert {m.log_time_ns for m in found.messages} == {42}
    assert found.messages[0].stamp_ns == logmaker.START_NS
    assert threading.get_ident() not in found.threads
    # frames, ellipsoids and diagnostics are of no use to a front end
    assert set(source.by_topic()["unknown_type"]) == {"/tf", "/tf_static", "/spheres", "/health"}
    assert source.counters()["received"] == sum(
        n for k, n in source.counters().items() if k not in ("received", "reconnects")
    )


def test_a_chunk_that_is_flushed_arrives_before_the_stream_ends():
    data = recording(5, 30_000)
    hold = threading.Event()

    def serve(connection: socket.socket, _: int) -> None:
        connection.sendall(data[: len(data) // 2])
        hold.wait(10)

    found = Collector()
    with tcp_server(serve) as port:
        source = McapStream(f"tcp://127.0.0.1:{port}")
        source.start(found)
        wait_for(lambda: found.messages)
        assert source.connected()
        hold.set()
        source.stop()


def test_a_lost_connection_is_opened_again():
    data = recording()

    def serve(connection: socket.socket, number: int) -> None:
        # the first two break in the middle of a record
        connection.sendall(data[: 30_000 if number < 2 else len(data)])

    found = Collector()
    with tcp_server(serve) as port:
        source = McapStream(f"tcp://127.0.0.1:{port}")
        source.start(found)
        wait_for(lambda: found.topics().get("/health", 0) or source.counters().get("reconnects", 0) >= 3)
        source.stop()
    assert source.counters()["reconnects"] >= 2
    assert source.counters()["malformed"] >= 2
    assert found.messages


def test_a_server_that_comes_later_is_found():
    port = free_port()
    found = Collector()
    source = McapStream(f"tcp://127.0.0.1:{port}")
    source.start(found)
    wait_for(lambda: "refused" in source.status())
    assert not source.connected()
    data = recording(2)
    with tcp_server(lambda c, _: in_pieces(c, data), port):
        wait_for(lambda: found.messages)
        source.stop()


def test_a_server_that_says_nothing_does_not_hold_up_the_end():
    hold = threading.Event()
    with tcp_server(lambda c, _: hold.wait(10)) as port:
        source = McapStream(f"tcp://127.0.0.1:{port}")
        source.start(Collector())
        wait_for(source.connected)
        begun = time.monotonic()
        source.stop()
        assert time.monotonic() - begun < 5
        assert source.ended()
        hold.set()


@pytest.mark.parametrize("chunk_size", [None, 30_000])
def test_garbage_in_the_stream_is_counted_and_left_behind(chunk_size):
    """After a corrupt length the connection is opened again, and the next stream is read."""
    data = recording(3, chunk_size)
    broken = data[:20_000] + b"\xff" * 200 + data[20_000:]

    found = Collector()
    with tcp_server(lambda c, number: c.sendall(broken if number == 0 else data)) as port:
        source = McapStream(f"tcp://127.0.0.1:{port}")
        source.start(found)
        wait_for(lambda: source.counters().get("reconnects", 0) >= 1 and found.topics()["/picks"] >= 3)
        source.stop()
    assert source.counters()["malformed"] >= 1


@pytest.mark.parametrize(
    "other",
    [b"", b"HTTP/1.1 400 Bad Request\r\n\r\n", b"\x89MCAP0\r", b"\x00" * 5000],
    ids=["empty", "http", "cut", "zero"],
)
def test_what_is_no_mcap_at_all_is_told(other: bytes):
    with tcp_server(lambda c, _: c.sendall(other)) as port:
        source = McapStream(f"tcp://127.0.0.1:{port}")
        source.start(Collector())
        wait_for(lambda: source.counters().get("reconnects", 0) >= 1)
        source.stop()
    assert source.status()
    assert "delivered" not in source.counters()


def test_a_message_of_100_mb_is_passed_over_and_the_stream_goes_on():
    data = recording(1)
    header = data[: 8 + 9 + struct.unpack_from("<Q", data, 9)[0]]
    size = 100 << 20

    def serve(connection: socket.socket, _: int) -> None:
        connection.sendall(header + struct.pack("<BQ", 0x05, size))
        piece = bytes(1 << 20)
        for _ in range(100):
            connection.sendall(piece)
        connection.sendall(data[len(header) :])
        hold.wait(10)

    hold = threading.Event()
    found = Collector()
    with tcp_server(serve) as port:
        source = McapStream(f"tcp://127.0.0.1:{port}", limits=Limits(message_bytes=8 << 20))
        source.start(found)
        wait_for(lambda: found.topics()["/picks"] >= 1)
        source.stop()
        hold.set()
    assert source.counters()["oversized"] == 1
    assert source.counters().get("reconnects", 0) == 0


def test_standard_input_ends_when_the_pipe_does():
    code = """
import sys, time
from surecut.io.live.mcap_stream import McapStream
found = []
source = McapStream("-")
source.start(lambda m: found.append(m.topic))
while not source.ended(): time.sleep(0.01)
source.stop()
print(len(found), source.counters())
"""
    done = subprocess.run([sys.executable, "-c", code], input=recording(), capture_output=True, timeout=60, check=True)
    assert done.stdout.split()[0] == b"70"


SMALL = {chunk_size: recording(1, chunk_size) for chunk_size in (None, 20_000)}


@settings(max_examples=120, deadline=None)
@given(
    st.sampled_from([None, 20_000]),
    st.lists(st.tuples(st.integers(8, 1 << 24), st.binary(min_size=1, max_size=12)), min_size=1, max_size=6),
    st.booleans(),
)
def test_any_damage_to_a_stream_is_survived(chunk_size, writes, untrusted_network):
    data = bytearray(SMALL[chunk_size])
    for at, value in writes:
        start = 8 + at % (len(data) - 8)
        data[start : start + len(value)] = value
    flaws: list[Damage] = []
    rules = Untrusted(1 << 20, flaws.append, resynchronise=untrusted_network)
    for record in RecordStream(io.BytesIO(bytes(data)), "x", with_crc=False, untrusted=rules):
        assert record is not None
    assert all(isinstance(flaw.reason, str) for flaw in flaws)


@pytest.mark.parametrize("address", ["tcp://:1", "tcp://host", "udp://a:1", "", "tcp://a:99999", "tcp://[::1"])
def test_addresses_are_checked(address: str):
    with pytest.raises(LogError, match="no address"):
        tcp_target(address)
