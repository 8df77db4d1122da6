"""What goes through a passage comes out as it went in, whether it found room in the shared memory or not."""

import multiprocessing
import queue

import numpy as np
import pytest

from surecut.estimator.passage import Passage

CONTEXT = multiprocessing.get_context("spawn")
ROOM = 1 << 16


def picture(number: int, size: int, readonly: bool = False) -> np.ndarray:
    image = np.random.default_rng(number).integers(0, 256, size, dtype=np.uint8)
    image.flags.writeable = not readonly
    return image


def same(one: np.ndarray, other: np.ndarray) -> bool:
    return one.dtype == other.dtype and one.flags.writeable == other.flags.writeable and np.array_equal(one, other)


@pytest.mark.parametrize("room_bytes", [0, ROOM])
def test_what_goes_in_comes_out(room_bytes: int):
    passage, random = Passage(CONTEXT, 8, room_bytes), np.random.default_rng(1)
    waiting = []
    for number in range(200):  # many times round the memory, now and then with more than it holds
        sizes = random.choice([0, 100, 20_000, 30_000, ROOM, 70_000], random.integers(0, 4))
        item = number, [picture(number, size, readonly=bool(number % 2)) for size in sizes]
        passage.put(item)
        waiting.append(item)
        while len(waiting) > random.integers(0, 6):
            (sent, pictures), (got, others) = waiting.pop(0), passage.get(timeout=60.0)
            assert sent == got
            assert len(pictures) == len(others)
            assert all(same(one, other) for one, other in zip(pictures, others, strict=True))


def test_what_has_come_out_stays_as_it_is():
    passage = Passage(CONTEXT, 8, ROOM)
    passage.put(picture(1, ROOM, readonly=True))
    first = passage.get(timeout=60.0)
    passage.put(picture(2, ROOM))
    passage.get(timeout=60.0)
    assert np.array_equal(first, picture(1, ROOM))


def test_nothing_comes_of_nothing():
    passage = Passage(CONTEXT, 8, ROOM)
    with pytest.raises(queue.Empty):
        passage.get(timeout=0.01)
    assert passage.empty()
    passage.close()
