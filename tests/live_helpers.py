"""Threads, sockets and waiting, for the tests of live transports."""

import contextlib
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from surecut.io.live.interfaces import (
    Fault,
    Health,
    HealthState,
    LiveImage,
    LivePoint,
    LivePose,
    LiveUpdate,
    Outline,
    Severity,
)
from surecut.io.messages import Message


class Collector:
    """Where a source delivers to."""

    def __init__(self) -> None:
        self.messages: list[Message] = []
        self.threads: set[int] = set()

    def __call__(self, message: Message) -> None:
        self.messages.append(message)
        self.threads.add(threading.get_ident())

    def topics(self) -> Counter[str]:
        return Counter(message.topic for message in self.messages)


def wait_for(condition: Callable[[], Any], timeout_s: float = 30.0) -> None:
    """Until the condition holds; fails the test when it does not come true."""
    end = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end, "it did not come true in time"
        time.sleep(0.005)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@contextlib.contextmanager
def tcp_server(serve: Callable[[socket.socket, int], None], port: int = 0) -> Iterator[int]:
    """Hands each connection, and its number, to `serve` in a thread of its own; gives the port."""
    listener = socket.create_server(("127.0.0.1", port))
    threads: list[threading.Thread] = []

    def handle(connection: socket.socket, number: int) -> None:
        with connection, contextlib.suppress(OSError):
            serve(connection, number)

    def accept() -> None:
        with contextlib.suppress(OSError):
            number = 0
            while True:
                connection, _ = listener.accept()
                threads.append(threading.Thread(target=handle, args=(connection, number), daemon=True))
                threads[-1].start()
                number += 1

    accepting = threading.Thread(target=accept, daemon=True)
    accepting.start()
    try:
        yield listener.getsockname()[1]
    finally:
        listener.shutdown(socket.SHUT_RDWR)
        listener.close()
        for thread in [accepting, *threads]:
            thread.join(5)


def update(number: int = 0, state: HealthState = HealthState.OK, faults: tuple[Fault, ...] = ()) -> LiveUpdate:
    """A state of the estimate, different for each number."""
    stamp_ns = 1_700_000_000_000_000_000 + number * 50_000_000
    o_T_b = np.eye(4)
    o_T_b[:3, 3] = (0.5, 0.1 * number, 2.0)
    poses = {
        "m": LivePose(np.eye(4), np.diag([1e-4, 1e-4, 4e-4, 1e-6, 1e-6, 1e-6])),
        "b": LivePose(o_T_b, None),
    }
    cut = LivePoint(
        name="P1",
        role="cut",
        xyz_m=np.array([0.1, 0.2, 1.5 + number]),
        covariance_m2=np.diag([1e-6, 4e-6, 9e-6]),
        verdict="GO",
        age_s=0.25,
        axis=np.array([0.0, 0.0, 1.0]),
        radius_m=0.05,
    )
    grasp = LivePoint("P2", "grasp", np.array([0.1, 0.2, 1.0]), np.diag([1e-6, 4e-6, 9e-6]), "MEASURE MORE", 1.0)
    health = Health(state, faults)
    return LiveUpdate(
        stamp_ns,
        stamp_ns + 12_000_000,
        poses,
        (cut, grasp),
        "MEASURE MORE: P2",
        1.0,
        health,
        {"received": number},
        points_stamp_ns=stamp_ns - 50_000_000,
        points_covariance_m2=np.diag([1e-6, 4e-6, 9e-6] * 2),
    )


def frozen_camera(since_ns: int = 1_700_000_000_000_000_000) -> Fault:
    return Fault("camera_frozen", since_ns, "m_left shows the same image; restart the camera", Severity.ERROR)


def live_image(number: int = 0) -> LiveImage:
    pixels = np.full((24, 32), number % 256, dtype=np.uint8)
    corners = np.array([[3.0, 9.0], [9.0, 9.0], [9.0, 3.0], [3.0, 3.0]])
    return LiveImage(
        "/m/left/image_raw",
        1_700_000_000_000_000_000 + number * 50_000_000,
        "m_left",
        pixels,
        (Outline("f0/7", corners, True), Outline("f0/8", corners + 10, False)),
        {"P1": (12.0, 8.0)},
    )
