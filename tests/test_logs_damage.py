"""Damaged logs: nothing wrong gets through, nothing crashes, and what can be saved is saved."""

from __future__ import annotations

import json
import random
from collections import Counter
from pathlib import Path

import pytest
from mcap.writer import CompressionType

from benchmarks.damage import (
    HARD_KINDS,
    KINDS,
    Fingerprint,
    cut,
    fingerprints,
    make_log,
    make_logs,
    report,
    run_cases,
)
from semslam.logs.reader import LogReader, LossReport


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Three sound logs with image-sized payloads: zstd, lz4 and no compression."""
    return make_logs(tmp_path_factory.mktemp("logs"), frames=60)


def read(path: Path) -> tuple[Counter[Fingerprint], LossReport]:
    reader = LogReader([path])
    found = Counter(
        (message.channel.topic, message.channel.schema_name, message.log_time, message.sequence, message.data)
        for message in reader.messages()
    )
    return found, reader.losses


def test_random_damage_never_lets_a_wrong_message_through(logs: list[Path]) -> None:
    """Cuts, flipped bits and zeroed blocks: every message that comes out is an original, in order."""
    tallies = run_cases(logs, KINDS, cases=60, seed=7)
    print(report(tallies))
    assert [tally.failures for tally in tallies.values()] == [[], [], []]
    assert sum(tally.wrong + tally.crashes + tally.disordered for tally in tallies.values()) == 0
    for tally in tallies.values():
        assert tally.whole_shares == pytest.approx([1.0] * len(tally.whole_shares))  # every untouched chunk is read


def test_one_flipped_bit_costs_little(logs: list[Path]) -> None:
    """A flipped bit costs one chunk of about nine, wherever it falls."""
    tally = run_cases(logs, {"flip": KINDS["flip"]}, cases=30, seed=11)["flip"]
    assert min(tally.shares) > 0.8
    assert sum(tally.shares) / len(tally.shares) > 0.88


def test_harder_damage_lets_nothing_wrong_through_either(logs: list[Path]) -> None:
    """Many flips, lost bytes, blocks out of place, holes before a cut, and flips where the structure is dense."""
    tallies = run_cases(logs, HARD_KINDS, cases=40, seed=3)
    assert [tally.failures for tally in tallies.values()] == [[], [], [], [], []]
    assert sum(tally.wrong + tally.crashes + tally.disordered for tally in tallies.values()) == 0


def test_every_complete_chunk_survives_a_cut(logs: list[Path]) -> None:
    """However far the recording got, all its whole chunks are read and the report says that it was cut."""
    for path in logs:
        data, originals = path.read_bytes(), fingerprints(path)
        ends = chunk_ends(data)
        for case in range(6):
            damaged = cut(data, random.Random(case))
            whole = sum(end <= len(damaged) for end in ends)
            path.with_suffix(".cut").write_bytes(damaged)
            found, losses = read(path.with_suffix(".cut"))
            assert (losses.chunks_read, losses.truncated, losses.state) == (whole, True, "salvaged")
            assert found <= originals


def chunk_ends(data: bytes) -> list[int]:
    """Where each chunk ends, read off the bytes by hand."""
    position, ends = 8, []
    while position < len(data) - 8:
        opcode, length = data[position], int.from_bytes(data[position + 1 : position + 9], "little")
        position += 9 + length
        if opcode == 6:
            ends.append(position)
    return ends


def test_a_lost_footer_costs_no_message(logs: list[Path]) -> None:
    """Power loss in the last moment: 100 % of the messages, in log-time order, and a state that says so."""
    for path in logs:
        cut_off = path.with_suffix(".nofooter")
        cut_off.write_bytes(path.read_bytes()[:-20])
        found, losses = read(cut_off)
        assert found == fingerprints(path)
        assert (losses.state, losses.truncated, losses.messages_expected) == ("salvaged", True, None)


def test_the_report_names_what_was_lost(tmp_path: Path) -> None:
    """One damaged chunk: its bytes, its messages by topic and a sentence with its place; the same in JSON."""
    path = tmp_path / "kitchen.mcap"
    make_log(path, compression=CompressionType.ZSTD, frames=30)
    data, originals = bytearray(path.read_bytes()), fingerprints(path)
    data[chunk_ends(bytes(data))[2] - 1000] ^= 1
    path.write_bytes(data)
    found, losses = read(path)
    missing = Counter(topic for topic, *_ in (originals - found).elements())
    file = losses.files[0]
    assert (losses.state, losses.chunks_skipped, file.indexed, losses.truncated) == ("salvaged", 1, True, False)
    assert file.lost_by_topic == dict(missing)
    assert losses.messages_expected == losses.messages_read + missing.total() == originals.total()
    assert 256_000 < losses.bytes_skipped < 400_000
    assert losses.problems[0].startswith("chunk at byte ")
    assert losses.as_json()["files"] == [file.as_json()]


def test_the_report_does_not_depend_on_names(tmp_path: Path) -> None:
    """Copies under other names lose the same; of several files, the one that lost something is told by its number."""
    for name in ("a.mcap", "b.mcap"):
        make_log(tmp_path / name, compression=CompressionType.NONE, frames=5)
        (tmp_path / name).write_bytes((tmp_path / name).read_bytes()[:-30])
    alone = [read(tmp_path / name)[1] for name in ("a.mcap", "b.mcap")]
    assert alone[0].as_json() == alone[1].as_json()
    assert alone[0].problems[0] == "has no footer: the recording was cut short"
    make_log(tmp_path / "sound.mcap", compression=CompressionType.NONE, frames=5)
    both = LogReader([tmp_path / "sound.mcap", tmp_path / "b.mcap"])
    assert both.losses.problems == [f"file 2 of 2: {problem}" for problem in alone[1].problems]
    assert "mcap" not in json.dumps(both.losses.as_json())


def test_reading_twice_gives_the_same_messages_and_the_same_report(tmp_path: Path) -> None:
    """A reading starts from scratch: losses are not counted twice, and nothing depends on the first pass."""
    path = tmp_path / "log.mcap"
    make_log(path, compression=CompressionType.LZ4, frames=20)
    path.write_bytes(KINDS["zero"](path.read_bytes(), random.Random(5))[:-30])
    reader = LogReader([path])
    first, first_losses = list(reader.messages()), reader.losses.as_json()
    assert first
    assert list(reader.messages()) == first
    assert reader.losses.as_json() == first_losses
