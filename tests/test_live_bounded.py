"""The queue between threads: bounded by count and bytes, oldest first out, what is dear is never pushed out."""

import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from surecut.io.live.bounded import BoundedQueue
from surecut.io.live.tally import MAXIMUM_TOPICS, Tally


def test_the_oldest_goes_first_and_is_counted_by_topic():
    queue: BoundedQueue[int] = BoundedQueue(3, 1000)
    for number in range(5):
        assert queue.put(number, f"/t{number % 2}", 10)
    assert queue.dropped_by_topic() == {"/t0": 1, "/t1": 1}
    assert [queue.get(0) for _ in range(4)] == [2, 3, 4, None]


def test_bytes_are_bounded_too():
    queue: BoundedQueue[int] = BoundedQueue(100, 100)
    for number in range(5):
        queue.put(number, "/t", 40)
    assert (len(queue), queue.size_bytes, queue.dropped()) == (2, 80, 3)
    assert not queue.put(9, "/t", 101)
    assert len(queue) == 2
    assert queue.dropped() == 4


def test_a_flood_of_images_never_drops_a_pick_and_order_is_kept():
    queue: BoundedQueue[str] = BoundedQueue(2, 1000)
    queue.put("a", "/image", 1)
    queue.put("pick", "/picks", 1, urgent=True)
    for name in "bcd":
        queue.put(name, "/image", 400)
    assert [queue.get(0) for _ in range(3)] == ["pick", "c", "d"]


def test_picks_are_bounded_among_themselves():
    queue: BoundedQueue[int] = BoundedQueue(2, 1000, maximum_urgent=3)
    for number in range(10):
        queue.put(number, "/picks", 1, urgent=True)
    assert [queue.get(0) for _ in range(4)] == [7, 8, 9, None]
    assert queue.dropped_by_topic() == {"/picks": 7}


def test_a_patient_producer_loses_nothing():
    queue: BoundedQueue[int] = BoundedQueue(2, 10)
    thread = threading.Thread(target=lambda: [queue.put_waiting(n, "/t", 4) for n in range(500)])
    thread.start()
    assert [queue.get(5) for _ in range(500)] == list(range(500))
    thread.join(5)
    assert queue.dropped() == 0


def test_closing_frees_whoever_waits():
    queue: BoundedQueue[int] = BoundedQueue(1, 10)
    queue.put(1, "/t", 1)
    results = []
    threads = [threading.Thread(target=lambda: results.append(queue.put_waiting(2, "/t", 1)))]
    threads[0].start()
    queue.close()
    threads[0].join(5)
    assert results == [False]
    assert [queue.get(), queue.get()] == [1, None]
    assert not queue.put(3, "/t", 1)


@given(st.lists(st.tuples(st.integers(0, 60), st.booleans(), st.booleans())), st.integers(1, 5), st.integers(1, 50))
def test_bounds_hold_and_everything_is_accounted_for(steps, count, size):
    queue: BoundedQueue[int] = BoundedQueue(count, size, maximum_urgent=2)
    taken = []
    for number, (length, urgent, take) in enumerate(steps):
        queue.put(number, "/t", length, urgent)
        assert len(queue) <= count + 2
        assert queue.size_bytes <= size
        if take and (item := queue.get(0)) is not None:
            taken.append(item)
    while (item := queue.get(0)) is not None:
        taken.append(item)
    assert taken == sorted(taken)
    assert len(taken) + queue.dropped() == len(steps)
    assert queue.size_bytes == 0


def test_topics_of_strangers_cannot_fill_the_memory():
    tally = Tally()
    for number in range(MAXIMUM_TOPICS + 50):
        tally.add("malformed", f"/t{number}")
    topics = tally.by_topic()["malformed"]
    assert len(topics) == MAXIMUM_TOPICS + 1
    assert topics["other"] == 50
    assert tally.totals() == {"malformed": pytest.approx(MAXIMUM_TOPICS + 50)}
