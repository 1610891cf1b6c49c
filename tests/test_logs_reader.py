"""Reading MCAP: order, memory, and every known trap, on files whose bytes are written here by hand."""

from __future__ import annotations

import os
import random
import struct
import tracemalloc
import zlib
from collections.abc import Sequence
from pathlib import Path

import lz4.frame  # type: ignore[import-untyped]
import pytest
import zstandard
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, IndexType, Writer

from semslam.errors import SemslamError
from semslam.logs.reader import LogReader, RawMessage

MAGIC = b"\x89MCAP0\r\n"


# Bytes by hand, after https://mcap.dev/spec, so that the reader has a witness other than a writer library.


def record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def text(value: str) -> bytes:
    return struct.pack("<I", len(value.encode())) + value.encode()


def pairs(values: dict[str, str]) -> bytes:
    body = b"".join(text(key) + text(value) for key, value in values.items())
    return struct.pack("<I", len(body)) + body


def header() -> bytes:
    return record(1, text("") + text("by hand"))


def schema(schema_id: int, name: str, data: bytes = b"float32 x") -> bytes:
    return record(3, struct.pack("<H", schema_id) + text(name) + text("ros2msg") + struct.pack("<I", len(data)) + data)


def channel(channel_id: int, topic: str, schema_id: int = 0, encoding: str = "cdr") -> bytes:
    return record(4, struct.pack("<HH", channel_id, schema_id) + text(topic) + text(encoding) + pairs({"qos": "1"}))


def message(channel_id: int, time: int, data: bytes = b"data", sequence: int = 0) -> bytes:
    return record(5, struct.pack("<HIQQ", channel_id, sequence, time, time + 1) + data)


def chunk(
    *records: bytes,
    times: tuple[int, int] = (0, 0),
    compression: str = "",
    crc: int | None = None,
    size: int | None = None,
    stored: bytes | None = None,
) -> bytes:
    """A chunk of `records`; every claim in its head can be made a lie."""
    body = b"".join(records)
    packed = {"": bytes, "zstd": zstandard.compress, "lz4": lz4.frame.compress}.get(compression, bytes)(body)
    packed = packed if stored is None else stored
    size = len(body) if size is None else size
    crc = zlib.crc32(body) if crc is None else crc
    front = struct.pack("<QQQI", *times, size, crc) + text(compression) + struct.pack("<Q", len(packed))
    return record(6, front + packed)


def message_index(channel_id: int, entries: Sequence[tuple[int, int]]) -> bytes:
    body = b"".join(struct.pack("<QQ", *entry) for entry in entries)
    return record(7, struct.pack("<HI", channel_id, len(body)) + body)


def chunk_index(offset: int, chunk_record: bytes, channel_ids: Sequence[int] = ()) -> bytes:
    start, end, size, _, name_length = struct.unpack_from("<QQQII", chunk_record, 9)
    name = chunk_record[41 : 41 + name_length].decode()
    stored = len(chunk_record) - 49 - name_length
    body = struct.pack("<QQQQ", start, end, offset, len(chunk_record)) + struct.pack("<I", 10 * len(channel_ids))
    body += b"".join(struct.pack("<HQ", channel_id, 0) for channel_id in channel_ids)
    return record(8, body + struct.pack("<Q", 0) + text(name) + struct.pack("<QQ", stored, size))


def metadata(name: str, values: dict[str, str]) -> bytes:
    return record(12, text(name) + pairs(values))


def attachment(name: str, data: bytes) -> bytes:
    covered = struct.pack("<QQ", 5, 4) + text(name) + text("text/plain") + struct.pack("<Q", len(data)) + data
    return record(9, covered + struct.pack("<I", zlib.crc32(covered)))


def log(*records: bytes, summary: Sequence[bytes] = (), data_crc: bool = False) -> bytes:
    """A finished file. With a summary, its checksum is in the footer."""
    data = MAGIC + header() + b"".join(records)
    data += record(15, struct.pack("<I", zlib.crc32(data) if data_crc else 0))
    section = b"".join(summary)
    footer = struct.pack("<BQQQ", 2, 20, len(data) if section else 0, 0)
    return data + section + footer + struct.pack("<I", zlib.crc32(section + footer) if section else 0) + MAGIC


def indexed_log(*records: bytes, definitions: Sequence[bytes]) -> bytes:
    """A finished file whose summary repeats `definitions` and indexes every chunk among `records`."""
    offset, indexes = len(MAGIC + header()), []
    for entry in records:
        if entry[0] == 6:
            indexes.append(chunk_index(offset, entry))
        offset += len(entry)
    return log(*records, summary=[*definitions, *indexes])


def save(folder: Path, data: bytes, name: str = "log.mcap") -> Path:
    path = folder / name
    path.write_bytes(data)
    return path


def read(*paths: Path) -> tuple[list[tuple[str, int, bytes]], LogReader]:
    reader = LogReader(paths)
    return [(each.channel.topic, each.log_time, each.data) for each in reader.messages()], reader


def times(messages: Sequence[tuple[str, int, bytes]]) -> list[int]:
    return [time for _, time, _ in messages]


# What an undamaged recording gives.


def test_a_message_arrives_with_all_its_fields(tmp_path: Path) -> None:
    """Topic, schema, encoding, metadata, both times, sequence and payload, as written."""
    definitions = [schema(3, "pkg/msg/Thing", b"int8 x"), channel(9, "/thing", 3)]
    path = save(tmp_path, log(chunk(*definitions, message(9, 70, b"payload", 6), times=(70, 70))))
    (found,) = LogReader([path]).messages()
    assert (found.log_time, found.publish_time, found.sequence, found.data) == (70, 71, 6, b"payload")
    thing = found.channel
    assert (thing.topic, thing.schema_name, thing.schema_encoding) == ("/thing", "pkg/msg/Thing", "ros2msg")
    assert (thing.schema_data, thing.message_encoding, dict(thing.metadata)) == (b"int8 x", "cdr", {"qos": "1"})


def test_only_wanted_channels_are_given_but_all_are_verified(tmp_path: Path) -> None:
    """The choice is asked once per channel; a damaged chunk of unwanted messages is still reported."""
    definitions = [channel(1, "/a"), channel(2, "/b")]
    sound = chunk(*definitions, *(message(1 + i % 2, i) for i in range(10)), times=(0, 9))
    broken = chunk(message(2, 10), times=(10, 10), crc=1)
    reader = LogReader([save(tmp_path, log(sound, broken))])
    asked: list[str] = []
    found = list(reader.messages(lambda each: asked.append(each.topic) or each.topic == "/a"))  # type: ignore[func-returns-value]
    assert [each.log_time for each in found] == [0, 2, 4, 6, 8]
    assert sorted(asked) == ["/a", "/b"]
    assert (reader.losses.messages_read, reader.losses.chunks_skipped) == (10, 1)


def test_an_error_in_the_choice_of_channels_is_not_taken_for_damage(tmp_path: Path) -> None:
    """The caller's own exception reaches the caller."""
    reader = LogReader([save(tmp_path, log(chunk(channel(1, "/a"), message(1, 1), times=(1, 1))))])
    with pytest.raises(KeyError, match="/a"):
        list(reader.messages(lambda each: {"/b": True}[each.topic]))


def test_the_report_is_clean_before_and_after_a_sound_log_is_read(tmp_path: Path) -> None:
    """Messages not read yet are not lost messages."""
    path = tmp_path / "sound.mcap"
    writer = Writer(str(path))
    writer.start()
    writer.add_message(writer.register_channel("/x", "json", 0), 1, b"{}", 1)
    writer.finish()  # type: ignore[no-untyped-call]
    reader = LogReader([path])
    assert (reader.losses.state, reader.losses.messages_expected, reader.losses.messages_read) == ("ok", 1, 0)
    assert len(list(reader.messages())) == 1
    assert (reader.losses.state, reader.losses.messages_missing, reader.losses.messages_read) == ("ok", 0, 1)


def test_records_of_equal_content_are_one_channel(tmp_path: Path) -> None:
    """Two ids in one file and a third in its continuation: one object. Another encoding of the topic: another one."""
    first = chunk(schema(1, "S"), schema(2, "S"), channel(1, "/x", 1), channel(2, "/x", 2), channel(3, "/x", 2, "json"))
    second = chunk(schema(7, "S"), channel(7, "/x", 7), message(7, 5), times=(5, 5))
    paths = [
        save(tmp_path, log(first, chunk(message(1, 1), message(2, 2), message(3, 3), times=(1, 3))), "0.mcap"),
        save(tmp_path, log(second), "1.mcap"),
    ]
    reader = LogReader(paths)
    found = [each.channel for each in reader.messages()]
    assert found[0] is found[1] is found[3]
    assert found[2] is not found[0]
    assert [(each.message_encoding, count) for each, count in reader.channels()] == [("cdr", 3), ("json", 1)]


def test_same_schema_name_with_other_content_stays_apart(tmp_path: Path) -> None:
    """Several schema ids may share a name; each channel keeps the definition it was recorded with."""
    parts = [schema(1, "S", b"old"), schema(2, "S", b"new"), channel(1, "/x", 1), channel(2, "/x", 2)]
    path = save(tmp_path, log(chunk(*parts, message(1, 1), message(2, 2), times=(1, 2))))
    assert [each.channel.schema_data for each in LogReader([path]).messages()] == [b"old", b"new"]


@pytest.mark.parametrize("with_index", [True, False])
def test_overlapping_chunks_come_out_in_log_time_order(tmp_path: Path, with_index: bool) -> None:
    """With or without a chunk index, whatever the order of chunks in the file; equal times keep file order."""
    definition = channel(1, "/x")
    chunks = [
        chunk(definition, message(1, 8), message(1, 4), message(1, 6), times=(4, 8)),
        chunk(message(1, 5, b"a"), message(1, 7), message(1, 6, b"b"), times=(5, 7)),
        chunk(message(1, 1), message(1, 2), times=(1, 2)),
    ]
    data = indexed_log(*chunks, definitions=[definition]) if with_index else log(*chunks)
    found, reader = read(save(tmp_path, data))
    assert times(found) == [1, 2, 4, 5, 6, 6, 7, 8]
    assert [payload for _, time, payload in found if time == 6] == [b"data", b"b"]
    assert (reader.losses.files[0].indexed, reader.losses.state) == (with_index, "ok")
    assert reader.losses.late_messages == 0


def test_split_files_are_merged_by_log_time(tmp_path: Path) -> None:
    """A recording in two files that overlap, given in the wrong order, comes out as one."""
    first = log(chunk(channel(1, "/x"), message(1, 1), message(1, 4), times=(1, 4)))
    second = log(chunk(channel(8, "/x"), message(8, 3), message(8, 9), times=(3, 9)))
    found, reader = read(save(tmp_path, second, "1.mcap"), save(tmp_path, first, "0.mcap"))
    assert times(found) == [1, 3, 4, 9]
    assert [file.name for file in reader.losses.files] == ["1.mcap", "0.mcap"]


def test_an_empty_part_of_a_recording_is_a_loss_like_others(tmp_path: Path) -> None:
    """A recorder that died as it opened the next file leaves one of 0 bytes: the others are read, the gap is told."""
    whole = log(chunk(channel(1, "/x"), message(1, 1), message(1, 4), times=(1, 4)))
    found, reader = read(save(tmp_path, whole, "0.mcap"), save(tmp_path, b"", "1.mcap"))
    assert times(found) == [1, 4]
    assert (reader.losses.state, reader.losses.truncated) == ("salvaged", True)
    assert reader.losses.problems == ["file 2 of 2: is empty (0 bytes)"]
    assert [(c.topic, count) for c, count in reader.channels()] == [("/x", 2)]
    assert "empty" in refusal(save(tmp_path, b"", "1.mcap"), save(tmp_path, b"", "2.mcap")).message


Messages = list[tuple[int, int, bytes]]


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    messages=st.lists(st.tuples(st.integers(0, 2), st.integers(0, 50), st.binary(max_size=40)), max_size=60),
    chunk_size=st.integers(40, 400),
    compression=st.sampled_from(list(CompressionType)),
    chunking=st.booleans(),
    index=st.sampled_from([IndexType.ALL, IndexType.NONE]),
    repeat=st.booleans(),
)
def test_any_layout_gives_the_same_sorted_messages(
    tmp_path: Path,
    messages: Messages,
    chunk_size: int,
    compression: CompressionType,
    chunking: bool,
    index: IndexType,
    repeat: bool,
) -> None:
    """Chunked, indexed, compressed, repeated in the summary, cut short, or not: a stable sort by time."""
    path = tmp_path / "any.mcap"
    writer = Writer(
        str(path),
        chunk_size=chunk_size,
        compression=compression,
        use_chunking=chunking,
        index_types=index,
        repeat_channels=repeat,
        repeat_schemas=repeat,
    )
    writer.start()
    ids = [writer.register_channel(f"/{i}", "cdr", writer.register_schema(f"S{i}", "ros2msg", b"")) for i in range(3)]
    for which, time, data in messages:
        writer.add_message(ids[which], time, data, time)
    writer.finish()  # type: ignore[no-untyped-call]
    expected = sorted(((f"/{which}", time, data) for which, time, data in messages), key=lambda entry: entry[1])
    found, reader = read(path)
    assert (found, reader.losses.state) == (expected, "ok")
    counts = {each.topic: count for each, count in reader.channels() if count}
    assert counts == {topic: times_seen for topic in counts if (times_seen := sum(e[0] == topic for e in expected))}
    path.write_bytes(path.read_bytes()[:-25])
    cut, reader = read(path)
    assert (cut, reader.losses.state) == (expected, "salvaged")


# The traps.


def test_messages_outside_chunks_are_read(tmp_path: Path) -> None:
    """A log without any chunk, in log-time order; counted as unverified, since no checksum covers them."""
    found, reader = read(save(tmp_path, log(channel(1, "/x"), *(message(1, time) for time in (3, 1, 2)))))
    assert times(found) == [1, 2, 3]
    assert (reader.losses.state, reader.losses.messages_unverified) == ("ok", 3)
    assert [count for _, count in reader.channels()] == [3]


def test_messages_between_indexed_chunks_are_read(tmp_path: Path) -> None:
    """A chunk index says nothing of messages outside chunks, nor of chunks it left out; they are found all the same."""
    definition = channel(1, "/x")
    first, second = (chunk(message(1, time), times=(time, time)) for time in (10, 30))
    forgotten = chunk(message(1, 25), times=(25, 25))
    records = (definition, first, message(1, 20), metadata("m", {"k": "v"}), forgotten, second, message(1, 40))
    offset = len(MAGIC + header() + definition)
    indexes = [chunk_index(offset, first), chunk_index(offset + len(b"".join(records[1:5])), second)]
    found, reader = read(save(tmp_path, log(*records, summary=[definition, *indexes])))
    assert times(found) == [10, 20, 25, 30, 40]
    assert (reader.losses.files[0].indexed, reader.losses.state) == (True, "ok")
    assert [entry.values for entry in reader.metadata()] == [{"k": "v"}]


def test_channels_that_the_summary_does_not_repeat_are_found_in_chunks(tmp_path: Path) -> None:
    """The chunk that describes the channel is the last one in time: nothing is lost, nothing raises."""
    late = chunk(schema(1, "S"), channel(1, "/x", 1), message(1, 9), times=(9, 9))
    early = chunk(message(1, 2), times=(2, 2))
    found, reader = read(save(tmp_path, indexed_log(late, early, definitions=[])))
    assert times(found) == [2, 9]
    assert reader.losses.state == "ok"


def test_a_summary_that_repeats_only_some_channels_is_not_relied_on(tmp_path: Path) -> None:
    """The index says that the early chunk holds channel 2, which only the late chunk describes."""
    late = chunk(channel(1, "/x"), channel(2, "/y"), message(1, 9), times=(9, 9))
    early = chunk(message(2, 2), times=(2, 2))
    start = len(MAGIC + header())
    indexes = [chunk_index(start, late, [1]), chunk_index(start + len(late), early, [2])]
    found, reader = read(save(tmp_path, log(late, early, summary=[channel(1, "/x"), *indexes])))
    assert [(topic, time) for topic, time, _ in found] == [("/y", 2), ("/x", 9)]
    assert reader.losses.state == "ok"


def test_without_an_index_chunks_are_ordered_by_what_they_hold(tmp_path: Path) -> None:
    """The times in front of a chunk are under no checksum; the messages in it are."""
    parts = (chunk(channel(1, "/x"), message(1, 1), times=(90, 90)), chunk(message(1, 2), times=(2, 2)))
    found, reader = read(save(tmp_path, log(*parts)))
    assert (times(found), reader.losses.late_messages) == ([1, 2], 0)


def test_records_of_a_later_format_version_are_skipped(tmp_path: Path) -> None:
    """Unknown opcodes in the data section, in a chunk and in the summary change nothing."""
    new = record(0x77, b"from the future")
    definition = channel(1, "/x")
    body = chunk(new, definition, new, message(1, 5), new, times=(5, 5))
    found, reader = read(save(tmp_path, log(new, body, new, summary=[new, definition])))
    assert times(found) == [5]
    assert reader.losses.state == "ok"


def test_an_id_with_two_meanings_is_never_guessed(tmp_path: Path) -> None:
    """Chunks that define the id are read with their own meaning; a message elsewhere is dropped and counted."""
    chunks = [
        chunk(schema(1, "Old"), channel(1, "/old", 1), message(1, 1), times=(1, 1)),
        chunk(schema(1, "New"), channel(1, "/new", 1), message(1, 2), times=(2, 2)),
        chunk(message(1, 3), times=(3, 3)),
    ]
    reader = LogReader([save(tmp_path, log(*chunks))])
    found = [(each.channel.topic, each.channel.schema_name, each.log_time) for each in reader.messages()]
    assert found == [("/old", "Old", 1), ("/new", "New", 2)]
    assert (reader.losses.messages_unknown_channel, reader.losses.state) == (1, "salvaged")


def test_a_definition_under_a_checksum_beats_one_without(tmp_path: Path) -> None:
    """A damaged channel record stands outside chunks, a sound one inside: the sound one holds for the whole file."""
    chunks = chunk(channel(1, "/right"), message(1, 1), times=(1, 1)), chunk(message(1, 2), times=(2, 2))
    found, reader = read(save(tmp_path, log(channel(1, "/wrong"), *chunks)))
    assert [topic for topic, _, _ in found] == ["/right", "/right"]
    assert reader.losses.state == "ok"


def test_messages_of_unknown_channels_are_dropped_and_counted(tmp_path: Path) -> None:
    """No surviving record describes the channel, or its schema: better no message than one of unknown meaning."""
    body = chunk(channel(1, "/x"), channel(2, "/y", 5), message(1, 1), message(2, 2), message(3, 3), times=(1, 3))
    found, reader = read(save(tmp_path, log(body)))
    assert found == [("/x", 1, b"data")]
    assert (reader.losses.messages_unknown_channel, reader.losses.state) == (2, "salvaged")


def test_ten_thousand_channels_are_read(tmp_path: Path) -> None:
    """Each channel with its own topic and schema, with and without the summary."""
    path = tmp_path / "many.mcap"
    writer = Writer(str(path), chunk_size=200_000)
    writer.start()
    for rank in range(10_000):
        schema_id = writer.register_schema(f"S{rank}", "ros2msg", b"")
        writer.add_message(writer.register_channel(f"/{rank}", "cdr", schema_id), rank, b"x", rank)
    writer.finish()  # type: ignore[no-untyped-call]
    for _ in ("finished", "cut"):
        found, reader = read(path)
        assert found == [(f"/{rank}", rank, b"x") for rank in range(10_000)]
        assert len(reader.channels()) == 10_000
        assert {count for _, count in reader.channels()} == {1}
        path.write_bytes(path.read_bytes()[:-9])


def absurd_chunks() -> dict[str, bytes]:
    """Chunks that claim, or would unpack to, more than anyone has."""
    zeros, stream = bytes(1 << 26), zstandard.ZstdCompressor().compressobj()
    sizeless = stream.compress(zeros) + stream.flush()
    known = channel(1, "/x")
    return {
        "terabytes unpacked": chunk(message(1, 5), size=1 << 42),
        "terabytes packed": struct.pack("<BQ", 6, 1 << 42) + bytes(40),
        "a record longer than the file": record(0x99, b"").replace(bytes(8), struct.pack("<Q", 1 << 60)),
        "a zstd bomb": chunk(size=1000, compression="zstd", stored=zstandard.compress(zeros)),
        "a zstd bomb that states its size": chunk(size=1 << 40, compression="zstd", stored=zstandard.compress(zeros)),
        "a zstd bomb that states no size": chunk(size=3 << 30, compression="zstd", stored=sizeless),
        "an lz4 bomb": chunk(size=1000, compression="lz4", stored=lz4.frame.compress(zeros)),
        "a huge name": record(6, struct.pack("<QQQII", 5, 5, 9, 0, 1 << 31) + bytes(60)),
        "an unknown compression": chunk(message(1, 5), compression="brotli"),
        "not what it says": chunk(message(1, 5), compression="zstd", stored=b"garbage"),
        "an lz4 frame without its end": chunk(known, crc=0, compression="lz4", stored=lz4.frame.compress(known)[:-4]),
        "a message longer than its chunk": chunk(message(1, 5)[:-2]),
        "a schema in bad UTF-8": chunk(record(3, struct.pack("<HI", 1, 2) + b"\xff\xfe" + bytes(8))),
        "a message too short to be one": chunk(record(5, b"short")),
    }


@pytest.mark.parametrize("name", absurd_chunks())
def test_absurd_chunks_are_skipped_without_taking_memory(tmp_path: Path, name: str) -> None:
    """Only the absurd chunk is lost; nothing is allocated on its word; the rest of the log is read."""
    parts = (
        chunk(channel(1, "/x"), message(1, 1), times=(1, 1)),
        absurd_chunks()[name],
        chunk(message(1, 9), times=(9, 9)),
    )
    path = save(tmp_path, log(*parts))
    tracemalloc.start()
    found, reader = read(path)
    peak_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert times(found) == [1, 9]
    assert reader.losses.state == "salvaged"
    assert reader.losses.bytes_skipped >= len(parts[1])
    assert peak_bytes < 8 << 20


def test_an_index_that_lies_is_not_followed(tmp_path: Path) -> None:
    """Chunk indexes that overlap, or point outside the data, make the reader walk the file instead."""
    definition = channel(1, "/x")
    first, second = (chunk(definition, message(1, time), times=(time, time)) for time in (1, 2))
    for offset in (len(MAGIC + header()) + 1, 1 << 50):
        lies = [chunk_index(len(MAGIC + header()), first), chunk_index(offset, second)]
        found, reader = read(save(tmp_path, log(first, second, summary=[definition, *lies])))
        assert times(found) == [1, 2]
        assert not reader.losses.files[0].indexed


def test_a_damaged_chunk_head_is_made_good_by_the_index(tmp_path: Path) -> None:
    """The summary's checksum vouches for sizes and times, the chunk's for its contents: nothing is lost."""
    definition = channel(1, "/x")
    body = chunk(definition, message(1, 5), times=(5, 5), compression="zstd")
    data = bytearray(indexed_log(body, definitions=[definition]))
    data[len(MAGIC + header()) + 9 + 16] ^= 0xFF  # the claimed size
    found, reader = read(save(tmp_path, bytes(data)))
    assert times(found) == [5]
    assert reader.losses.state == "ok"


def test_a_zeroed_chunk_head_does_not_pass_for_a_chunk_without_checksum(tmp_path: Path) -> None:
    """Its CRC field reads 0, which elsewhere means that the writer stored none; here it means damage."""
    definition = channel(1, "/x")
    body = chunk(definition, message(1, 5, b"right"), times=(5, 5))
    data = bytearray(indexed_log(body, definitions=[definition]).replace(b"right", b"wrong"))
    start = len(MAGIC + header()) + 9
    data[start : start + 32] = bytes(32)
    found, reader = read(save(tmp_path, bytes(data)))
    assert (found, reader.losses.chunks_skipped) == ([], 1)


def test_a_flipped_topic_in_the_summary_is_not_believed(tmp_path: Path) -> None:
    """The summary's checksum fails, so its channels are not taken, and the state says that something is wrong."""
    definition = channel(1, "/right")
    body = chunk(definition, message(1, 5), times=(5, 5))
    data = indexed_log(body, definitions=[definition])
    at = data.rindex(b"/right")
    found, reader = read(save(tmp_path, data[:at] + b"/wrong" + data[at + 6 :]))
    assert found == [("/right", 5, b"data")]
    assert (reader.losses.state, reader.losses.files[0].summary_damaged) == ("salvaged", True)


def test_channels_described_only_in_the_summary_are_taken_from_there(tmp_path: Path) -> None:
    """The chunk that described them is damaged: the other chunks are still read."""
    definition = channel(1, "/x")
    chunks = (chunk(definition, message(1, 1), times=(1, 1), crc=99), chunk(message(1, 2), times=(2, 2)))
    for data in (indexed_log(*chunks, definitions=[definition]), log(*chunks, summary=[definition])):
        found, reader = read(save(tmp_path, data))
        assert times(found) == [2]
        assert (reader.losses.chunks_skipped, reader.losses.state) == (1, "salvaged")


def test_a_summary_that_has_moved_is_found(tmp_path: Path) -> None:
    """Bytes are missing in the middle, and with them the chunk that described the channel: the footer points astray."""
    definition = channel(1, "/x")
    first, second = chunk(definition, message(1, 1), times=(1, 1)), chunk(message(1, 2), times=(2, 2))
    data = indexed_log(first, second, definitions=[definition])
    found, reader = read(save(tmp_path, data.replace(first, first[:30])))
    assert times(found) == [2]
    assert (reader.losses.state, reader.losses.files[0].summary_damaged) == ("salvaged", True)


# Messages that no chunk checksum covers.


def test_a_data_section_checksum_vouches_for_bare_messages(tmp_path: Path) -> None:
    """It holds: all are read as verified. It fails: any of them may be the wrong one, so none is."""
    data = log(channel(1, "/x"), *(message(1, time, b"right") for time in range(5)), data_crc=True)
    found, reader = read(save(tmp_path, data))
    assert (len(found), reader.losses.messages_unverified, reader.losses.state) == (5, 0, "ok")
    found, reader = read(save(tmp_path, data.replace(b"right", b"wrong", 1)))
    assert (found, reader.losses.messages_damaged, reader.losses.state) == ([], 5, "salvaged")


def test_a_chunk_without_checksum_must_agree_with_its_message_index(tmp_path: Path) -> None:
    """The index repeats every message's time and place: a flipped time, channel or length shows."""
    records = [channel(1, "/x"), channel(2, "/y"), message(1, 5)]
    place = len(records[0] + records[1])
    body = chunk(*records, times=(5, 5), crc=0)
    found, reader = read(save(tmp_path, log(body, message_index(1, [(5, place)]))))
    assert (times(found), reader.losses.messages_unverified) == ([5], 1)
    for index in (message_index(1, [(6, place)]), message_index(2, [(5, place)]), message_index(1, [(5, place + 1)])):
        found, reader = read(save(tmp_path, log(body, index)))
        assert (found, reader.losses.chunks_skipped) == ([], 1)


def test_an_unchunked_log_goes_on_after_a_broken_record(tmp_path: Path) -> None:
    """The message before the break is dropped too (its end may be damaged); three sound ones in a row end the gap."""
    messages = [message(1, time, random.Random(time).randbytes(200)) for time in range(20)]
    data = bytearray(log(channel(1, "/x"), *messages))
    start = len(MAGIC + header() + channel(1, "/x")) + 10 * len(messages[0])
    data[start : start + 9] = bytes(9)
    found, reader = read(save(tmp_path, bytes(data)))
    assert times(found) == [*range(9), *range(11, 20)]
    assert (reader.losses.messages_damaged, reader.losses.state) == (1, "salvaged")
    found, reader = read(save(tmp_path, bytes(data[: start + 3 * len(messages[0])])))  # cut two messages later
    assert times(found) == [*range(9), 11, 12]


# Attachments, metadata, appendices.


def test_attachments_and_metadata_are_given_and_damaged_ones_counted(tmp_path: Path) -> None:
    """An attachment whose checksum fails is left out and counted once, however often it is asked for."""
    data = log(attachment("a.txt", b"fine"), metadata("robot", {"name": "r2"}), attachment("b.txt", b"good"))
    path = save(tmp_path, data.replace(b"good", b"evil"))
    reader = LogReader([path])
    for _ in range(2):
        assert [(each.name, each.data, each.log_nanos, each.create_nanos) for each in reader.attachments()] == [
            ("a.txt", b"fine", 5, 4)
        ]
    assert [(each.name, each.values) for each in reader.metadata()] == [("robot", {"name": "r2"})]
    assert (reader.losses.state, len(reader.losses.problems)) == ("salvaged", 1)
    assert "b.txt" in reader.losses.problems[0]


def test_bytes_behind_the_end_are_reported(tmp_path: Path) -> None:
    """Two logs in one file (`cat a b`): the first is read, the rest is counted, not mixed in."""
    first, second = (log(chunk(channel(1, f"/{n}"), message(1, n), times=(n, n))) for n in (1, 2))
    found, reader = read(save(tmp_path, first + second + b"\0\0\0"))
    assert times(found) == [1]
    assert reader.losses.bytes_skipped == len(second) + 3


# Memory.


def test_memory_does_not_grow_with_the_file(tmp_path: Path) -> None:
    """120 MB of camera images are read in a few MB, indexed and after power loss alike."""
    path = tmp_path / "long.mcap"
    image = random.Random(0).randbytes(200_000)
    writer = Writer(str(path), chunk_size=1 << 20, compression=CompressionType.NONE)
    writer.start()
    camera = writer.register_channel("/camera", "jpeg", 0)
    for frame in range(600):
        writer.add_message(camera, frame, image, frame)
    writer.finish()  # type: ignore[no-untyped-call]
    assert path.stat().st_size > 120_000_000
    assert peak_of_reading(path) < 6 << 20
    os.truncate(path, path.stat().st_size - 10)
    assert peak_of_reading(path) < 6 << 20


def peak_of_reading(path: Path) -> int:
    """Bytes that Python held at most."""
    tracemalloc.start()
    assert sum(1 for _ in LogReader([path]).messages()) == 600
    peak_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak_bytes


def test_overlap_beyond_the_memory_allowed_is_read_late_and_counted(tmp_path: Path) -> None:
    """Thirty chunks that all span the whole recording: in order with enough memory; without, still whole."""
    chunks = [
        chunk(
            channel(1, "/x"), *(message(1, 100 * i + rank, bytes(10_000)) for i in range(5)), times=(rank, 400 + rank)
        )
        for rank in range(30)
    ]
    path = save(tmp_path, indexed_log(*chunks, definitions=[channel(1, "/x")]))
    found, reader = read(path)
    assert (times(found), reader.losses.late_messages) == (sorted(times(found)), 0)
    small = LogReader([path], memory_bytes=200_000)
    tracemalloc.start()
    stamps = [each.log_time for each in small.messages()]
    peak_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert sorted(stamps) == times(found)
    late = sum(stamp < max(stamps[:rank], default=0) for rank, stamp in enumerate(stamps))
    assert small.losses.late_messages == late > 0
    assert (small.losses.state, peak_bytes < 500_000) == ("ok", True)


# Refusals.


def refusal(path: Path, *more: Path) -> SemslamError:
    with pytest.raises(SemslamError) as caught:
        LogReader([path, *more])
    assert str(path) in caught.value.message
    assert caught.value.hint
    return caught.value


@pytest.mark.parametrize(
    ("data", "what"),
    [
        (b"", "empty"),
        (b"hello, I am a text file", "not an MCAP file"),
        (bytes(100_000), "not an MCAP file"),
        (b"#ROSBAG V2.0\n" + bytes(99), "ROS 1 bag"),
        (b"SQLite format 3\0" + bytes(99), "sqlite3 bag"),
        (zstandard.compress(log(message(1, 1))), "zstd-compressed"),
        (lz4.frame.compress(log(message(1, 1))), "lz4-compressed"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:00", "Git LFS"),
    ],
)
def test_what_is_not_a_log_is_refused_by_name(tmp_path: Path, data: bytes, what: str) -> None:
    """One error that names the file, what it is instead, and what to do."""
    assert what in refusal(save(tmp_path, data)).message


def test_files_that_cannot_be_opened_are_refused_by_name(tmp_path: Path) -> None:
    """A missing file, a folder (with a hint at the logs inside), the same file twice, no file at all."""
    path = save(tmp_path, log())
    assert "No such file" in refusal(tmp_path / "missing.mcap").message
    assert "*.mcap" in refusal(tmp_path).hint
    assert "twice" in refusal(path, tmp_path / "." / "log.mcap").message
    with pytest.raises(SemslamError, match="No log file"):
        LogReader([])


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_a_file_without_permission_is_refused_by_name(tmp_path: Path) -> None:
    """Permission denied is said as such, with the way out."""
    path = save(tmp_path, log())
    path.chmod(0)
    assert "chmod" in refusal(path).hint


def test_a_file_that_lost_its_first_bytes_is_still_read(tmp_path: Path) -> None:
    """The first disk block is zeroed, with it MCAP's magic: the chunks behind it are found."""
    definition = channel(1, "/x")
    data = log(chunk(definition, message(1, 1), times=(1, 1)), chunk(definition, message(1, 2), times=(2, 2)))
    headless = bytes(40) + data[40:]
    for damaged in (headless, headless[:-10]):
        found, reader = read(save(tmp_path, damaged))
        assert times(found) == [2]
        assert reader.losses.state == "salvaged"


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    soup=st.lists(
        st.one_of(
            st.binary(max_size=80),
            st.sampled_from([channel(1, "/x"), schema(1, "S"), message(1, 3), chunk(message(1, 2)), metadata("a", {})]),
            st.builds(record, st.integers(0, 255), st.binary(max_size=60)),
        ),
        max_size=8,
    ),
    finished=st.booleans(),
)
def test_no_sequence_of_bytes_makes_the_reader_crash(tmp_path: Path, soup: list[bytes], finished: bool) -> None:
    """Records and noise in any order: messages or a SemslamError, never another exception."""
    data = log(*soup, summary=soup) if finished else MAGIC + b"".join(soup)
    reader = LogReader([save(tmp_path, data)])
    messages: list[RawMessage] = list(reader.messages())
    assert all(each.channel.topic == "/x" for each in messages)
    assert len(list(reader.attachments())) + len(list(reader.metadata())) + len(reader.channels()) >= 0
    assert reader.losses.as_json()["state"] in ("ok", "salvaged")
