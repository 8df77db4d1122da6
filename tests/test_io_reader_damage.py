"""Logs that are cut, flipped or left by a killed recorder: what is whole is read, what is lost is told."""

import io
from collections import Counter
from pathlib import Path

import logmaker
import numpy as np
import pytest
from reader_helpers import Open

from surecut.factors.errors import LogError
from surecut.io.reader import LogReader


def counts(reader: LogReader) -> Counter[str]:
    return Counter(message.topic for message in reader)


@pytest.mark.parametrize(
    "options", [{"chunk_size": 20_000}, {"chunk_size": 20_000, "compression": "none"}, {"chunk_size": None}]
)
def test_a_log_cut_anywhere_gives_what_is_whole(open_log: Open, tmp_path: Path, options):
    whole = tmp_path / "whole.mcap"
    logmaker.write_log(whole, 8, **options)
    data = whole.read_bytes()
    expected = [(m.topic, m.log_time_ns) for m in LogReader(whole)]
    longest = 0
    for cut in [9, 50, *np.random.default_rng(3).integers(60, len(data) - 1, 40).tolist(), len(data) - 1]:
        path = tmp_path / "cut.mcap"
        path.write_bytes(data[:cut])
        with open_log(path) as reader:
            got = [(m.topic, m.log_time_ns) for m in reader]
            warnings = reader.warnings
        assert got == expected[: len(got)]
        longest = max(longest, len(got))
        if len(got) < len(expected):
            assert len(warnings) == 1, cut
            assert warnings[0].count("cut off") == 1
            assert f"cut off at byte {cut}" in warnings[0]
            assert f"{len(got)} messages read" in warnings[0]
    assert longest > 0.8 * len(expected)


def test_a_cut_chunk_tells_which_times_are_lost(open_log: Open, tmp_path: Path):
    path = tmp_path / "log.mcap"
    logmaker.write_log(path, 20, chunk_size=1 << 22)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with open_log(path) as reader:
        assert counts(reader) == {}
        assert "unusable (messages between 1000.001 s and 1000.951 s); 0 messages read" in reader.warnings[0]


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_a_flipped_bit_costs_one_chunk(open_log: Open, tmp_path: Path, compression):
    whole = tmp_path / "whole.mcap"
    logmaker.write_log(whole, 20, chunk_size=40_000, compression=compression, rig=None)
    data = bytearray(whole.read_bytes())
    expected = Counter((m.topic, m.log_time_ns) for m in LogReader(whole))
    position = len(data) // 2
    data[position] ^= 4
    path = tmp_path / "flipped.mcap"
    path.write_bytes(data)
    with open_log(path) as reader:
        got = Counter((m.topic, m.log_time_ns) for m in reader)
        warnings = reader.warnings
    assert not got - expected
    lost = sum((expected - got).values())
    assert 0 < lost < 0.4 * sum(expected.values())
    assert len(warnings) == 1
    assert "1 corrupt place skipped" in warnings[0]
    assert "messages lost between 1000." in warnings[0]


def test_any_flipped_bit_gives_no_wrong_message(tmp_path: Path):
    """Flips over the whole file, lengths and headers included: what is read is what was written."""
    whole = tmp_path / "whole.mcap"
    logmaker.write_log(whole, 10, chunk_size=15_000)
    data = whole.read_bytes()
    expected = Counter((m.topic, m.log_time_ns, m.stamp_ns) for m in LogReader(whole))
    rng = np.random.default_rng(5)
    unread = 0
    for position in rng.integers(8, len(data) - 8, 150).tolist():
        damaged = bytearray(data)
        damaged[position] ^= 1 << int(rng.integers(8))
        reader = LogReader(io.BytesIO(bytes(damaged)))
        try:
            got = Counter((m.topic, m.log_time_ns, m.stamp_ns) for m in reader)
        except LogError:
            unread += 1
            continue
        assert not got - expected
        lost = sum((expected - got).values())
        assert bool(reader.warnings) or not lost
        assert lost < 0.75 * sum(expected.values())
    assert unread < 10


def test_a_flipped_bit_outside_chunks_is_told(open_log: Open, tmp_path: Path):
    path = tmp_path / "log.mcap"
    logmaker.write_log(path, 5, chunk_size=None)
    data = bytearray(path.read_bytes())
    data[data.index(logmaker.picture(3).tobytes()) + 99] ^= 1
    path.write_bytes(data)
    with open_log(path) as reader:
        assert sum(counts(reader).values()) == 5 * 18
        assert "the checksum over all records differs" in reader.warnings[0]


def test_the_next_chunk_is_found_after_a_broken_length(open_log: Open, tmp_path: Path):
    whole = tmp_path / "whole.mcap"
    logmaker.write_log(whole, 20, chunk_size=40_000, compression="zstd", rig=None)
    data = bytearray(whole.read_bytes())
    total = sum(counts(LogReader(whole)).values())
    second = data.index(b"zstd", data.index(b"zstd") + 4) - 32 - 9
    assert data[second] == 6
    data[second + 6] ^= 1  # the chunk becomes 2^40 bytes long
    path = tmp_path / "broken.mcap"
    path.write_bytes(data)
    with open_log(path) as reader:
        assert 0.5 * total < sum(counts(reader).values()) < total
        assert "the record's length is corrupt" in reader.warnings[0]


def test_descriptions_come_from_the_end_when_the_first_chunk_is_lost(tmp_path: Path):
    whole = tmp_path / "whole.mcap"
    logmaker.write_log(whole, 20, chunk_size=40_000, compression="zstd", rig=None)
    data = bytearray(whole.read_bytes())
    data[data.index(b"zstd") + 200] ^= 1
    path = tmp_path / "broken.mcap"
    path.write_bytes(data)
    with LogReader(path) as reader:
        assert len(counts(reader)) == 18
        assert len(reader.warnings) == 1
    stream = LogReader(io.BytesIO(bytes(data)))  # a stream has no end to look at
    assert not counts(stream)
    assert any("which nothing describes" in text for text in stream.warnings)


def test_a_damaged_attachment_is_not_given(tmp_path: Path):
    path = tmp_path / "log.mcap"
    logmaker.write_log(path, 2)
    data = bytearray(path.read_bytes())
    data[data.index(b"boards:")] ^= 1
    path.write_bytes(data)
    with LogReader(path) as reader:
        assert reader.attachment("rig.yaml") is None
        assert sum(counts(reader).values()) == 36
        assert "checksum of attachment 'rig.yaml' differs" in reader.warnings[0]


def test_what_a_killed_recorder_leaves_is_read(tmp_path: Path):
    from surecut.io.writer import McapSink

    sink = McapSink(tmp_path / "log.mcap", chunk_size=1 << 20)
    for number in range(30):
        for topic, type_name, message in logmaker.messages(number):
            sink.write(topic, type_name, message, logmaker.START_NS + number)
        if number % 10 == 9:
            sink.flush()
        if number == 25:
            break
    (left,) = tmp_path.glob(".log.mcap.*.part")
    with LogReader(left) as reader:
        assert sum(counts(reader).values()) == 20 * 18
        assert "cut off" in reader.warnings[0]
    sink.abort()
