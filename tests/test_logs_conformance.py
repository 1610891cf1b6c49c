"""The 416 files of the MCAP conformance suite and 20 logs of rosbag2, read to the last field."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from semslam.errors import SemslamError
from semslam.logs.reader import Attachment, Channel, LogReader, Metadata, RawMessage


def data_folder(name: str) -> Path:
    """A folder of the shared test data, or a skip that says what is missing."""
    root = os.environ.get("SEMSLAM_TEST_DATA")
    if not root:
        pytest.skip("SEMSLAM_TEST_DATA is not set")
    folder = Path(root) / name
    if not folder.is_dir():
        pytest.skip(f"`{folder}` does not exist")
    return folder


Record = dict[str, Any]


def expected_records(path: Path) -> list[tuple[str, Record]]:
    """(type, fields) of every record that the suite lists for a file."""
    records = json.loads(path.with_suffix(".json").read_text())["records"]
    return [(record["type"], dict(record["fields"])) for record in records]


def as_bytes(numbers: list[str]) -> bytes:
    return bytes(int(number) for number in numbers)


def expected_channels(records: list[tuple[str, Record]]) -> dict[str, Channel]:
    """Channel by id, bound to its schema as the suite's JSON describes both."""
    schemas: dict[str, Record] = {"0": {"name": "", "encoding": "", "data": []}}
    schemas |= {fields["id"]: fields for kind, fields in records if kind == "Schema"}
    channels = {}
    for _, fields in (record for record in records if record[0] == "Channel"):
        schema = schemas[fields["schema_id"]]
        channels[fields["id"]] = Channel(
            fields["topic"],
            schema["name"],
            schema["encoding"],
            as_bytes(schema["data"]),
            fields["message_encoding"],
            fields["metadata"],
        )
    return channels


def expected_messages(records: list[tuple[str, Record]]) -> list[RawMessage]:
    """Every message, by log time; equal times in file order."""
    channels = expected_channels(records)
    messages = [
        RawMessage(
            channels[fields["channel_id"]],
            int(fields["log_time"]),
            int(fields["publish_time"]),
            int(fields["sequence"]),
            as_bytes(fields["data"]),
        )
        for kind, fields in records
        if kind == "Message"
    ]
    return sorted(messages, key=lambda message: message.log_time)


def expected_attachments(records: list[tuple[str, Record]]) -> list[Attachment]:
    return [
        Attachment(
            fields["name"],
            fields["media_type"],
            int(fields["log_time"]),
            int(fields["create_time"]),
            as_bytes(fields["data"]),
        )
        for kind, fields in records
        if kind == "Attachment"
    ]


def expected_metadata(records: list[tuple[str, Record]]) -> list[Metadata]:
    return [Metadata(fields["name"], fields["metadata"]) for kind, fields in records if kind == "Metadata"]


def mismatches(path: Path) -> Iterator[str]:
    """What differs between a file as read and as the suite describes it."""
    records = expected_records(path)
    reader = LogReader([path])
    messages = expected_messages(records)
    found: dict[str, tuple[object, object]] = {
        "messages": (list(reader.messages()), messages),
        "channels": ({channel for channel, _ in reader.channels()}, set(expected_channels(records).values())),
        "attachments": (list(reader.attachments()), expected_attachments(records)),
        "metadata": (list(reader.metadata()), expected_metadata(records)),
        "state": (reader.losses.state, "ok"),
        "unverified messages": (reader.losses.messages_unverified, 0),
    }
    counts = [count for _, count in reader.channels()]
    if None not in counts:
        found["count"] = (sum(count or 0 for count in counts), len(messages))
    for what, (read, expected) in found.items():
        if read != expected:
            yield f"{path.name}: {what} {read!r}, expected {expected!r}"


def test_every_conformance_file_is_read_with_exactly_the_expected_contents() -> None:
    """All 416 files: messages, channels with schemas and metadata, attachments, metadata records, nothing lost."""
    files = sorted(data_folder("mcap-conformance").rglob("*.mcap"))
    failing = {path.name: list(mismatches(path)) for path in files}
    failing = {name: problems for name, problems in failing.items() if problems}
    print(f"{len(files) - len(failing)} of {len(files)} conformance files read as expected")
    assert not failing
    assert len(files) == 416


def read_or_refuse(path: Path) -> str:
    """`read` when every message the writer counted came out, `refused` when an error names the file."""
    try:
        reader = LogReader([path])
        messages = list(reader.messages())
    except SemslamError as error:
        return "refused" if path.name in error.message else f"refused without its name: {error.message}"
    expected, state = reader.losses.messages_expected, reader.losses.state
    counted = sum(count or 0 for _, count in reader.channels())
    complete = len(messages) == expected == counted and state == "ok"
    return "read" if complete else f"{len(messages)} of {expected} messages, {state}"


def test_every_rosbag2_log_is_read_or_refused_by_name() -> None:
    """Twenty logs as ROS 2 recorders write them, checksums or not, with services and unusual schemas."""
    files = sorted(data_folder("mcap-rosbag2").rglob("*.mcap"))
    outcomes = {str(path.parent.name) + path.name: read_or_refuse(path) for path in files}
    print(f"{list(outcomes.values()).count('read')} of {len(files)} rosbag2 logs read")
    assert len(files) == 20
    assert set(outcomes.values()) <= {"read", "refused"}, outcomes


def test_a_split_rosbag2_recording_comes_out_as_one() -> None:
    """Five files of one recording, given in any order: every message, by ascending log time."""
    files = sorted((data_folder("mcap-rosbag2") / "wbag").glob("*.mcap"))
    stamps = [message.log_time for message in LogReader(files[::-1]).messages()]
    assert len(stamps) == 1246 + 1240 + 1240 + 1240 + 1108
    assert stamps == sorted(stamps)
