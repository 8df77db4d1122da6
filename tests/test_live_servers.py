"""JSON lines for the arm's program, health and metrics for those who watch: over real sockets."""

import contextlib
import json
import socket
import time
import urllib.error
import urllib.request
from dataclasses import replace

import numpy as np
import pytest
from live_helpers import frozen_camera, update, wait_for
from prometheus_client.parser import text_string_to_metric_families

from surecut.io.live.access import Access, AccessError
from surecut.io.live.interfaces import HealthState, LivePoint, Pick, Reply, Reset
from surecut.io.live.json_server import JsonServer
from surecut.io.live.web_server import WebServer

TOKEN = "a token of sixteen or more"


@contextlib.contextmanager
def lines(access: Access | None = None, **options):
    commands = []
    server = JsonServer(access, 0, **options)
    server.start(lambda command: (commands.append(command), Reply(True, "queued"))[1])
    try:
        yield server, commands
    finally:
        server.stop()
        server.stop()


@contextlib.contextmanager
def connected(port: int):
    with socket.create_connection(("127.0.0.1", port), timeout=10) as connection, connection.makefile("rwb") as file:
        yield connection, file


def test_a_line_per_update():
    with lines() as (server, _), connected(server.port) as (_, file):
        wait_for(lambda: server.counters()["clients"] == 1)
        for number in range(3):
            server.publish(update(number))
        found = [json.loads(file.readline()) for _ in range(3)]
    assert [entry["stamp_ns"] for entry in found] == [update(n).stamp_ns for n in range(3)]
    first = found[0]["points"][0]
    assert first == {
        "id": "P1",
        "role": "cut",
        "frame": "b",
        "position_m": [0.1, 0.2, 1.5],
        "covariance_m2": [[1e-6, 0, 0], [0, 4e-6, 0], [0, 0, 9e-6]],
        "axis": [0, 0, 1],
        "radius_m": 0.05,
        "verdict": "GO",
        "age_s": 0.25,
    }
    assert found[0]["points_stamp_ns"] == update(0).points_stamp_ns
    assert found[0]["points_covariance_m2"] == np.diag([1e-6, 4e-6, 9e-6] * 2).tolist()
    assert found[0]["verdict"] == "MEASURE MORE: P2"
    assert found[0]["health"] == {"state": "ok", "faults": []}
    assert np.shape(found[0]["poses"]["m"]["matrix"]) == (4, 4)
    assert found[0]["poses"]["b"]["covariance"] is None


def test_what_is_not_finite_is_null_not_nonsense():
    point = LivePoint("P", "cut", np.array([np.nan, 1, np.inf]), np.full((3, 3), np.nan), "EXPIRED", float("inf"))
    with lines() as (server, _), connected(server.port) as (_, file):
        wait_for(lambda: server.counters()["clients"] == 1)
        whole = update()
        server.publish(replace(whole, points=(point,), age_s=float("nan")))
        found = json.loads(file.readline(), parse_constant=lambda text: pytest.fail(f"{text} is no JSON"))
    assert found["points"][0]["position_m"] == [None, 1.0, None]
    assert found["age_s"] is None


def test_commands_by_line_need_the_token():
    pick = {"command": "pick", "camera": "b_rgb", "point_id": "P1", "u": 1.0, "v": 2.0}
    with lines(Access(token=TOKEN)) as (server, commands), connected(server.port) as (_, file):
        for value in (
            pick,
            {**pick, "token": TOKEN},
            {"command": "reset", "token": TOKEN},
            {"command": "x", "token": TOKEN},
        ):
            file.write(json.dumps(value).encode() + b"\n")
        file.flush()
        replies = [json.loads(file.readline())["accepted"] for _ in range(4)]
        assert replies == [False, True, True, False]
        assert commands == [Pick("b_rgb", "P1", "cut", (1.0, 2.0), 0, 2.0), Reset()]
        assert server.counters()["unauthorised"] == 1
        file.write(5 * (json.dumps(pick).encode() + b"\n"))
        with contextlib.suppress(OSError):
            file.flush()
            while file.readline():
                pass
        wait_for(lambda: server.counters()["clients"] == 0)


@pytest.mark.parametrize(
    "data",
    [
        b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n" + b'{"command": "reset"}\n',
        b"\x16\x03\x01\x02\x00\x01\x00" * 10 + b"\n",
        b"{" * 10_000,
        b"null\n",
    ],
    ids=["http", "tls", "long", "null"],
)
def test_whoever_speaks_another_language_is_shown_the_door(data: bytes):
    """A web page can make a browser send anything that is HTTP."""
    with lines() as (server, commands), connected(server.port) as (connection, _):
        connection.sendall(data)
        wait_for(lambda: server.counters().get("malformed") == 1 and server.counters()["clients"] == 0)
        assert commands == []


@pytest.mark.parametrize(
    "line", [b"{}", b'{"command": "pick"}', b'{"command": 5}', b"{]", b'{"command": "reset", "x": 1}', b'{"\xff": 1}']
)
def test_garbage_as_a_command_is_counted_and_answered(line: bytes):
    with lines() as (server, commands), connected(server.port) as (_, file):
        file.write(line + b"\n" + b'{"command": "reset"}\n')
        file.flush()
        assert [json.loads(file.readline())["accepted"] for _ in range(2)] == [False, True]
        assert commands == [Reset()]
        assert server.counters()["malformed"] == 1


def test_a_client_that_does_not_read_loses_the_oldest_lines():
    with (
        lines(client_bytes=50_000) as (server, _),
        socket.socket() as stalled,
        connected(server.port) as (_, lively),
    ):
        stalled.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        stalled.connect(("127.0.0.1", server.port))
        wait_for(lambda: server.counters()["clients"] == 2)
        last = 0
        longest = 0.0
        for number in range(1000):
            begun = time.monotonic()
            server.publish(update(number))
            longest = max(longest, time.monotonic() - begun)
            last = json.loads(lively.readline())["stamp_ns"]
        assert last == update(999).stamp_ns
        assert server.counters()["dropped"] > 100
        assert longest < 1.0


def test_a_flood_of_connections_is_bounded():
    with lines(maximum_clients=4) as (server, _):
        flood = [socket.create_connection(("127.0.0.1", server.port)) for _ in range(40)]
        wait_for(lambda: server.counters().get("refused_connections") == 36)
        assert server.counters()["clients"] == 4
        for connection in flood:
            connection.close()
        wait_for(lambda: server.counters()["clients"] == 0)
        with connected(server.port) as (_, file):
            wait_for(lambda: server.counters()["clients"] == 1)
            server.publish(update())
            assert file.readline()


@pytest.mark.parametrize("kind", [JsonServer, WebServer])
def test_servers_listen_on_this_machine_alone(kind):
    with pytest.raises(AccessError, match="other machines"):
        kind(Access("0.0.0.0"))
    with pytest.raises(AccessError, match="other machines"):
        kind(Access("192.168.0.1"))
    server = kind(None, 0)
    server.start()
    try:
        with pytest.raises(AccessError, match="cannot listen"):
            kind(None, server.port).start()
    finally:
        server.stop()


@contextlib.contextmanager
def web(**options):
    server = WebServer(None, 0, **options)
    server.start()
    try:
        yield server
    finally:
        server.stop()
        server.stop()


def get(port: int, path: str) -> tuple[int, str]:
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}{path}", timeout=5) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read().decode()


def test_health_is_200_while_answers_come_and_503_otherwise():
    now = [10_000_000_000]
    with web(clock=lambda: now[0]) as server:
        status, body = get(server.port, "/healthz")
        assert (status, json.loads(body)["reason"]) == (503, "no update yet")
        server.publish(update(1, HealthState.DEGRADED, (frozen_camera(),)))
        status, body = get(server.port, "/healthz")
        assert status == 200
        assert json.loads(body)["faults"][0]["name"] == "camera_frozen"
        server.publish(update(1, HealthState.FAILED))
        assert get(server.port, "/healthz")[0] == 503
        server.publish(update(2))
        assert get(server.port, "/healthz")[0] == 200
        now[0] += 6_000_000_000  # the process says nothing any more
        status, body = get(server.port, "/healthz")
        assert (status, json.loads(body)["reason"]) == (503, "no update for 6.0 s")
        assert get(server.port, "/other")[0] == 404


def test_metrics_are_what_prometheus_reads():
    whole = update(7, HealthState.DEGRADED, (frozen_camera(), frozen_camera()))
    odd = LivePoint('a"b\n\\', "cut", np.zeros(3), np.full((3, 3), 0.0), "MY OWN", 3.0)
    whole = type(whole)(
        whole.stamp_ns, whole.sent_ns, {}, (*whole.points, odd), "", 0.0, whole.health, {"received": 70}
    )
    with web(extra=lambda: {"recording dropped": 3}) as server:
        assert "surecut_healthy 0.0" in get(server.port, "/metrics")[1]
        server.publish(whole)
        status, text = get(server.port, "/metrics")
    assert status == 200
    samples = {
        (sample.name, *sorted(sample.labels.values())): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }
    assert samples["surecut_healthy",] == 1
    assert samples["surecut_state", "degraded"] == 1
    assert samples["surecut_state", "ok"] == 0
    assert samples["surecut_fault", "camera_frozen", "error"] == 1
    assert samples["surecut_events_total", "received"] == 70
    assert samples["surecut_events_total", "recording dropped"] == 3
    assert samples["surecut_point_radius95_metres", "P1"] == pytest.approx(2.7955 * 3e-3, rel=1e-4)
    assert samples["surecut_point_verdict", "GO", "P1"] == 1
    assert samples["surecut_point_age_seconds", 'a"b\n\\'] == 3
    assert samples["surecut_delay_seconds",] == pytest.approx(0.012)


@pytest.mark.parametrize(
    "data",
    [b"\x00" * 200 + b"\r\n\r\n", b"GET /" + b"a" * 100_000 + b" HTTP/1.1\r\n\r\n", b"DELETE / HTTP/1.1\r\n\r\n"],
)
def test_bad_requests_are_survived(data: bytes, capfd):
    with web() as server:
        with socket.create_connection(("127.0.0.1", server.port)) as raw, contextlib.suppress(OSError):
            raw.sendall(data)
            raw.recv(100)
        server.publish(update())
        assert get(server.port, "/healthz")[0] == 200
    assert capfd.readouterr() == ("", "")


def test_those_who_connect_and_say_nothing_do_not_keep_others_out(monkeypatch):
    monkeypatch.setattr("surecut.io.live.web_server._Handler.timeout", 0.3)
    with web(maximum_requests=3) as server:
        server.publish(update())
        silent = [socket.create_connection(("127.0.0.1", server.port)) for _ in range(20)]
        wait_for(lambda: server.counters().get("refused_connections", 0) >= 17)
        time.sleep(0.5)
        assert get(server.port, "/healthz")[0] == 200
        for connection in silent:
            connection.close()


def test_publishing_costs_nothing_while_nobody_asks():
    with web() as server, lines() as (other, _):
        begun = time.process_time()
        for number in range(1000):
            server.publish(update(number))
            other.publish(update(number))
        assert time.process_time() - begun < 2.0
