"""Order by stamp and stereo pairs."""

from surecut.io.messages import Message, OtherBody
from surecut.io.ordering import OrderReport, sorted_by_stamp
from surecut.io.pairing import PairingReport, StereoPair, stereo_pairs

MS = 1_000_000
BODY = OtherBody("x", None)


def message(topic: str, stamp_ms: float, number: int = 0) -> Message:
    return Message(topic, number, int(stamp_ms * MS), "", BODY)


def test_messages_come_by_stamp_whatever_the_delay():
    arrivals = [message("/a", 1000 * k) for k in range(1, 20)]
    late = [message("/b", 1000 * k - 1500) for k in range(2, 20)]
    mixed = [m for pair in zip(arrivals, [*late, message("/b", 18_500)], strict=True) for m in pair]
    report = OrderReport()
    stamps = [m.stamp_ns for m in sorted_by_stamp(mixed, 2_000 * MS, report)]
    assert stamps == sorted(stamps)
    assert len(stamps) == len(mixed)
    assert (report.late, report.backwards, report.duplicated) == (0, {}, {})


def test_equal_stamps_keep_the_order_of_arrival():
    given = [message("/a", 5, 1), message("/b", 5, 2), message("/a", 5, 3)]
    report = OrderReport()
    assert [m.log_time_ns for m in sorted_by_stamp(given, report=report)] == [1, 2, 3]
    assert report.duplicated == {"/a": 1}


def test_what_comes_too_late_is_delivered_and_counted():
    given = [*(message("/a", 1000 * k) for k in range(1, 9)), message("/a", 1500), message("/a", 9000)]
    report = OrderReport()
    stamps = [m.stamp_ns // MS for m in sorted_by_stamp(given, 2_000 * MS, report)]
    assert sorted(stamps) == sorted(m.stamp_ns // MS for m in given)
    assert report.late == 1
    assert report.backwards == {"/a": 1}


def test_unset_stamps_are_delivered_at_once():
    report = OrderReport()
    given = [message("/a", 1000), message("/b", 0), message("/a", 1100)]
    assert [m.topic for m in sorted_by_stamp(given, report=report)] == ["/b", "/a", "/a"]
    assert report.zero == 1


def test_the_window_bounds_what_waits():
    def endless():
        k = 0
        while True:
            k += 1
            yield message("/a", 1000 * k)

    stream = sorted_by_stamp(endless(), 2_000 * MS)
    assert [next(stream).stamp_ns // MS for _ in range(3)] == [1000, 2000, 3000]


def pairs(given, **options):
    report = PairingReport()
    out = list(stereo_pairs(given, "/l", "/r", report=report, **options))
    return out, report


def test_equal_stamps_make_pairs_and_others_pass():
    given = [message("/l", 100), message("/x", 101), message("/r", 100), message("/r", 150), message("/l", 150)]
    out, report = pairs(given)
    assert [type(m).__name__ for m in out] == ["Message", "StereoPair", "StereoPair"]
    assert all(isinstance(m, Message) or m.left.topic == "/l" for m in out)
    assert (report.pairs, report.unpaired) == (2, {})


def test_nothing_is_lost():
    given = [message("/l", 50 * k) for k in range(1, 9)] + [message("/r", 50 * k) for k in (2, 3, 5)]
    out, report = pairs(given)
    assert report.pairs == 3
    assert report.unpaired == {"/l": 5}
    assert sum(2 if isinstance(m, StereoPair) else 1 for m in out) == len(given)


def test_tolerance():
    given = [message("/l", 100), message("/r", 100.9), message("/l", 150), message("/r", 151.1)]
    out, report = pairs(given, tolerance_ns=MS)
    assert report.pairs == 1
    assert report.unpaired == {"/l": 1, "/r": 1}
    assert report.largest_difference_ns == int(0.9 * MS)
    assert isinstance(out[0], StereoPair)
    assert out[0].stamp_ns == 100 * MS


def test_a_side_that_never_comes_does_not_fill_the_memory():
    stream = stereo_pairs((message("/l", 50 * k) for k in range(1, 10**9)), "/l", "/r", waiting=4)
    assert [next(stream).stamp_ns // MS for _ in range(3)] == [50, 100, 150]
