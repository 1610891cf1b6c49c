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
from semslam.logs.messages import Pose
from semslam.logs.reader import Channel, LogReader
from semslam.logs.roles import Roles, TopicSeen, choose_roles, describe_topics, peek
from semslam.stages.contract import FinishedShard, LogRefusedError, ShardWriter, StageContext
from semslam.stages.keyframes import Keyframe, KeyframeWalk, Row, TopicTally, static_transforms
from semslam.stages.settings import IngestConfig
from semslam.tables.spec import FRAMES, MOTION, TOPICS, TRUTH, Table

_PICTURES = ("colour", "depth", "colour_info", "depth_info")
_LOSSES = (
    "messages_missing",
    "messages_unverified",
    "messages_unknown_channel",
    "messages_damaged",
    "chunks_skipped",
    "bytes_skipped",
    "late_messages",
)
"""Totals of the reader's losses that the manifest counts."""
_NEEDED = {"colour": "colour image", "depth": "depth image", "colour_info": "camera calibration"}


def run(ctx: StageContext) -> None:
    """Walk through the log once and publish its keyframes shard by shard.

    A resumed run walks again, but decodes no image of a published shard.

    Raises:
        LogRefusedError: the log lacks colour, depth or calibration, or gives no keyframe.
    """
    config: IngestConfig = ctx.config
    reader = LogReader(ctx.sources)
    seen = peek(reader)
    roles = needed_roles(ctx.log, seen, config.topics, reader.losses.problems)
    reader = LogReader(ctx.sources)
    walk = KeyframeWalk(reader, roles, config, _known(ctx.finished), static_transforms(seen))
    keyframes = _Lookahead(walk.keyframes())
    if keyframes.ended:
        raise _nothing(ctx.log, walk, roles)
    index = 0
    while index == 0 or not keyframes.ended:
        if index < len(ctx.finished):
            for _ in islice(keyframes, config.shard_frames):
                pass
        else:
            with ctx.shard(index) as shard:
                _tell_roles(shard, roles, config)
                _write(ctx, shard, islice(keyframes, config.shard_frames), "truth" in roles.topics)
                if keyframes.ended:
                    _close(shard, walk, roles, reader)
                _give_notes(shard, walk, config)
        walk.start_notes()
        index += 1


def needed_roles(
    log: str, seen: Sequence[TopicSeen], overrides: Mapping[str, str], problems: Sequence[str] = ()
) -> Roles:
    """Topics by role, with everything that a map needs; `problems` is the damage the reader met.

    Raises:
        LogRefusedError: colour, depth or calibration is missing.
    """
    roles = choose_roles(seen, overrides)
    for role, what in _NEEDED.items():
        if role not in roles.topics:
            refused = [f"  {t.channel.topic}: {t.refusal}" for t in seen if t.refusal]
            details = [describe_topics(seen)]
            details += ["", "Refused", *refused[:10]] if refused else []
            details += ["", "Damage", *(f"  {problem}" for problem in problems[:5])] if problems else []
            hint = f"name the topic with `--topic {role}=/...`"
            if problems and not any(t.first for t in seen):
                hint = "the file is damaged beyond use; copy it again from where it was recorded"
            raise LogRefusedError(f"No {what} topic in `{log}`", details="\n".join(details), hint=hint)
    return roles


def _tell_roles(shard: ShardWriter, roles: Roles, config: IngestConfig) -> None:
    for role, seen in roles.topics.items():
        shard.remark(f"{role} is `{seen.channel.topic}` ({roles.why[role]})")
    truth = roles.topics.get("truth")
    if truth and isinstance(truth.first, Pose) and not config.truth_frame:
        shard.remark(
            f"`{truth.channel.topic}` does not say whose pose it tells: taken for the robot's; "
            "name another frame with `--set ingest.truth_frame=NAME`"
        )


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
    for name in _LOSSES:
        if number := int(getattr(losses, name)):
            shard.count(name, number)
    for warning in (*losses.problems, *walk.log_warnings()):
        shard.warn(warning)
    if losses.messages_unverified:
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


def _give_notes(shard: ShardWriter, walk: KeyframeWalk, config: IngestConfig) -> None:
    for name, number in sorted(walk.counts.items()):
        if number:
            shard.count(name, number)
    for warning in (*walk.warnings, *_shortcomings(walk.counts, config)):
        shard.warn(warning)


def _shortcomings(counts: Mapping[str, int], config: IngestConfig) -> Iterator[str]:
    """What the counts of some keyframes mean for the map."""
    frames = sum(number for name, number in counts.items() if name.startswith("level_"))
    if counts["level_none"] and config.levelling != "none":
        yield f"{counts['level_none']} of {frames} keyframes are not levelled: neither tf nor an IMU says where up is"
    if counts["motion_none"] and config.motion != "none":
        yield f"no motion for {counts['motion_none']} of {frames} keyframes: no source covers their time"
    if counts["images_out_of_order"]:
        yield f"{counts['images_out_of_order']} images dropped, because their stamps do not rise"
    if counts["colour_unpaired"] > 0.1 * (counts["pairs"] + counts["colour_unpaired"]):
        yield (
            f"{counts['colour_unpaired']} colour images have no depth image within {config.pair_tolerance_s:g} s; "
            "allow more with `--set ingest.pair_tolerance_s=0.1`"
        )
    if counts["frames_without_depth"]:
        yield f"{counts['frames_without_depth']} of {frames} depth images are empty where colour sees"
    if counts["frames_of_implausible_depth"]:
        yield (
            f"{counts['frames_of_implausible_depth']} of {frames} depth images have a median below 0.1 or above 30 m: "
            "a wrong unit? give metres a step with `--set ingest.depth_unit_m=0.001`"
        )


def _nothing(log: str, walk: KeyframeWalk, roles: Roles) -> LogRefusedError:
    if walk.counts["pairs_damaged"]:
        return _unusable(log, walk, roles)
    counts = ", ".join(f"{name} {number}" for name, number in sorted(walk.counts.items()) if number)
    seen = [f"  {channel.topic}: {tally.messages} messages" for channel, tally in walk.topics.items()]
    return LogRefusedError(
        f"No colour image with a depth image beside it in `{log}`",
        details="\n".join([*sorted(seen)[:40], *walk.warnings[:5], *([counts] if counts else [])]),
        hint="look with `semslam ingest --check LOG`; allow more time between the two with "
        "`--set ingest.pair_tolerance_s=0.1`",
    )


def _unusable(log: str, walk: KeyframeWalk, roles: Roles) -> LogRefusedError:
    """There are pairs, but none can be used: the reason matters, and the topics it may come from."""
    reasons = list(dict.fromkeys(warning.partition(": ")[2] for warning in walk.warnings if "skipped" in warning))
    topics = [f"  {role} is `{seen.channel.topic}`" for role, seen in roles.topics.items() if role in _PICTURES]
    return LogRefusedError(
        f"None of {walk.counts['pairs_damaged']} pairs of colour and depth in `{log}` can be used: {reasons[0]}",
        details="\n".join([*topics, *(f"  {reason}" for reason in reasons[1:5])]),
        hint="look with `semslam ingest --check LOG`; name other topics with `--topic ROLE=/...`",
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
