"""Ingest: from an MCAP log to keyframes with registered depth, a levelled camera, motion and truth.

Reads   the log's files
Writes  topics, frames, motion, truth      data_spec.md, tables 1 to 4
Paper   section III: the inputs (I_t, d_t) and u_t
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import islice
from typing import Any

from semslam.logs.decode import kind_of
from semslam.logs.reader import Channel, LogReader
from semslam.logs.roles import Roles, TopicSeen, choose_roles, describe_topics, peek
from semslam.stages.contract import FinishedShard, LogRefusedError, ShardWriter, StageContext
from semslam.stages.keyframes import Keyframe, KeyframeWalk, Row, TopicTally
from semslam.stages.settings import IngestConfig
from semslam.tables.spec import FRAMES, MOTION, TOPICS, TRUTH, Table

_NEEDED = {"colour": "colour image", "depth": "depth image", "colour_info": "camera calibration"}


def run(ctx: StageContext) -> None:
    """Walk through the log once and publish its keyframes shard by shard.

    A resumed run walks again, but decodes no image of a published shard.

    Raises:
        LogRefusedError: the log lacks colour, depth or calibration, or gives no keyframe.
    """
    config: IngestConfig = ctx.config
    roles = needed_roles(ctx.log, peek(LogReader(ctx.sources)), config.topics)
    reader = LogReader(ctx.sources)
    walk = KeyframeWalk(reader, roles, config, _known(ctx.finished))
    keyframes = _Lookahead(walk.keyframes())
    if keyframes.ended:
        raise _nothing(ctx.log, walk)
    index = 0
    while index == 0 or not keyframes.ended:
        if index < len(ctx.finished):
            for _ in islice(keyframes, config.shard_frames):
                pass
        else:
            with ctx.shard(index) as shard:
                _tell_roles(shard, roles)
                _write(ctx, shard, islice(keyframes, config.shard_frames), "truth" in roles.topics)
                if keyframes.ended:
                    _close(shard, walk, roles, reader)
                _give_notes(shard, walk)
        walk.start_notes()
        index += 1


def needed_roles(log: str, seen: Sequence[TopicSeen], overrides: Mapping[str, str]) -> Roles:
    """Topics by role, with everything that a map needs.

    Raises:
        LogRefusedError: colour, depth or calibration is missing.
    """
    roles = choose_roles(seen, overrides)
    for role, what in _NEEDED.items():
        if role not in roles.topics:
            refused = [f"  {t.channel.topic}: {t.refusal}" for t in seen if t.refusal]
            details = "\n".join([describe_topics(seen), *(["", "Refused:", *refused[:10]] if refused else [])])
            raise LogRefusedError(
                f"No {what} topic in `{log}`", details=details, hint=f"name the topic with `--topic {role}=/...`"
            )
    return roles


def _tell_roles(shard: ShardWriter, roles: Roles) -> None:
    for role, seen in roles.topics.items():
        shard.remark(f"{role} is `{seen.channel.topic}` ({roles.why[role]})")


def _write(ctx: StageContext, shard: ShardWriter, keyframes: Iterator[Keyframe], has_truth: bool) -> None:
    """One shard's keyframes, row by row, so that memory holds one image pair at a time."""
    sinks = {table.name: shard.table(table) for table in (FRAMES, MOTION, TOPICS)}
    if has_truth:
        sinks[TRUTH.name] = shard.table(TRUTH)
    stamps: list[int] = []
    floors: list[float | None] = []
    for keyframe in keyframes:
        sinks[FRAMES.name].append(_columns(FRAMES, [keyframe.frame]))
        sinks[MOTION.name].append(_columns(MOTION, [keyframe.motion]))
        if keyframe.truth is not None:
            sinks[TRUTH.name].append(_columns(TRUTH, [keyframe.truth]))
        stamps.append(keyframe.frame["stamp_nanos"])
        floors.append(keyframe.floor_m)
        ctx.progress(keyframe.frame["frame"] + 1)
    shard.note("stamps", stamps)
    shard.note("floors_m", floors)


def _close(shard: ShardWriter, walk: KeyframeWalk, roles: Roles, reader: LogReader) -> None:
    """What is known only when the whole log has been read: its topics and what was lost."""
    shard.table(TOPICS).append(_columns(TOPICS, topic_rows(walk, roles, reader)))
    losses = reader.losses
    shard.note("losses", losses.as_json())
    if losses.state != "ok":
        shard.count("logs_salvaged")
    for problem in losses.problems:
        shard.warn(problem)
    if losses.messages_unverified:
        shard.count("messages_unverified", losses.messages_unverified)
        shard.warn(f"{losses.messages_unverified:,} messages carry no checksum: damage in them cannot be noticed")


def topic_rows(walk: KeyframeWalk, roles: Roles, reader: LogReader) -> list[Row]:
    """Rows of the topics table, by name."""
    role_of = {seen.channel: role for role, seen in roles.topics.items()}
    listed: dict[Channel, TopicTally] = {channel: TopicTally() for channel, _ in reader.channels()}
    listed |= walk.topics
    rows = []
    for channel, tally in listed.items():
        role = role_of.get(channel) or ("tf" if kind_of(channel) == "transforms" else None)
        rows.append(
            {
                "topic": channel.topic,
                "schema_name": channel.schema_name,
                "message_encoding": channel.message_encoding,
                "role": role,
                "messages": tally.messages,
                "skipped": tally.skipped,
                "reason": tally.reason,
                "first_log_time_nanos": tally.first_log_time,
                "last_log_time_nanos": tally.last_log_time,
                "max_gap_s": None if tally.max_gap_nanos is None else tally.max_gap_nanos / 1e9,
                "clock_jumps": walk.clock.jumps(channel.topic),
            }
        )
    return sorted(rows, key=lambda row: (row["topic"], row["schema_name"], row["message_encoding"]))


def _give_notes(shard: ShardWriter, walk: KeyframeWalk) -> None:
    for name, number in sorted(walk.counts.items()):
        if number:
            shard.count(name, number)
    for warning in walk.warnings:
        shard.warn(warning)


def _nothing(log: str, walk: KeyframeWalk) -> LogRefusedError:
    counts = ", ".join(f"{name} {number}" for name, number in sorted(walk.counts.items()) if number)
    seen = [f"  {channel.topic}: {tally.messages} messages" for channel, tally in walk.topics.items()]
    return LogRefusedError(
        f"No colour image with a depth image beside it in `{log}`",
        details="\n".join([*sorted(seen)[:40], *walk.warnings[:5], *([counts] if counts else [])]),
        hint="look with `semslam ingest --check LOG`; allow more time between the two with "
        "`--set ingest.pair_tolerance_s=0.1`",
    )


def _known(finished: Sequence[FinishedShard]) -> Mapping[int, float | None]:
    known: dict[int, float | None] = {}
    for shard in finished:
        known.update(zip(shard.notes["stamps"], shard.notes["floors_m"], strict=True))
    return known


def _columns(table: Table, rows: Sequence[Row]) -> dict[str, list[Any]]:
    return {column.name: [row[column.name] for row in rows] for column in table.columns}


class _Lookahead:
    """An iterator that knows whether it has ended."""

    def __init__(self, items: Iterator[Keyframe]) -> None:
        self._items = items
        self._next = next(items, None)

    @property
    def ended(self) -> bool:
        """Whether nothing is left."""
        return self._next is None

    def __iter__(self) -> Iterator[Keyframe]:
        return self

    def __next__(self) -> Keyframe:
        if self._next is None:
            raise StopIteration
        item, self._next = self._next, next(self._items, None)
        return item
