"""How much of a damaged log survives, and whether anything wrong gets through.

Takes sound logs (one given, or three made here: zstd, lz4 and uncompressed chunks with image-sized payloads), damages a
copy at random, reads it with `LogReader` and compares every message with the originals. The baseline of the same run is
what the `mcap` package's own readers, checksums on, get out of the same files before they stop.

    python benchmarks/damage.py --cases 500 --seed 1
    python benchmarks/damage.py --cases 500 --seed 1 --hard
    python benchmarks/damage.py --log kitchen.mcap
    python benchmarks/damage.py --quick
"""

from __future__ import annotations

import argparse
import datetime
import importlib.metadata
import io
import platform
import random
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from mcap.reader import make_reader
from mcap.records import Channel, Chunk, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from semslam.errors import SemslamError
from semslam.logs.reader import LogReader

Damage = Callable[[bytes, random.Random], bytes]
Fingerprint = tuple[str, str, int, int, bytes]
"""(topic, schema name, log time, sequence, payload)."""


def make_log(path: Path, *, compression: CompressionType, frames: int = 60, seed: int = 0) -> None:
    """Record images of 20 to 60 kB (as incompressible as JPEG) beside two small topics, in chunks of 256 kB."""
    rng = random.Random(seed)
    with path.open("wb") as stream:
        writer = Writer(stream, compression=compression, chunk_size=256 << 10)
        writer.start(profile="ros2", library="semslam")
        image = _channel(writer, "/camera/image/compressed", "sensor_msgs/msg/CompressedImage")
        imu = _channel(writer, "/imu", "sensor_msgs/msg/Imu")
        tf = _channel(writer, "/tf", "tf2_msgs/msg/TFMessage")
        writer.add_metadata("robot", {"name": "kitchen"})
        for frame in range(frames):
            start_nanos = 1_700_000_000_000_000_000 + frame * 33_000_000
            writer.add_message(tf, start_nanos, rng.randbytes(120), start_nanos, frame)
            for tick in range(12):
                stamp = start_nanos + tick * 2_500_000
                writer.add_message(imu, stamp, rng.randbytes(320), stamp, frame * 12 + tick)
            jpeg = b"\xff\xd8\xff\xe0" + rng.randbytes(rng.randrange(20_000, 60_000)) + b"\xff\xd9"
            writer.add_message(image, start_nanos + 9_000_000, jpeg, start_nanos, frame)
        writer.finish()  # type: ignore[no-untyped-call]


def _channel(writer: Writer, topic: str, schema_name: str) -> int:
    schema = writer.register_schema(schema_name, "ros2msg", b"std_msgs/Header header\n" * 40)
    return writer.register_channel(topic, "cdr", schema, {"offered_qos_profiles": ""})


def cut(log: bytes, rng: random.Random) -> bytes:
    """The file ends early: power loss, a full disk."""
    return log[: rng.randrange(9, len(log))]


def flip(log: bytes, rng: random.Random) -> bytes:
    """One bit is wrong: a bad cable, memory, an old card."""
    damaged = bytearray(log)
    damaged[rng.randrange(len(log))] ^= 1 << rng.randrange(8)
    return bytes(damaged)


def zero(log: bytes, rng: random.Random) -> bytes:
    """Up to 64 kB were allocated but never written; half of the time in whole disk sectors."""
    length, start = rng.randrange(1, 64 << 10), rng.randrange(len(log))
    if rng.random() < 0.5:
        start, length = start & ~4095, (length + 4095) & ~4095
    length = min(length, len(log) - start)
    return log[:start] + bytes(length) + log[start + length :]


def flip_many(log: bytes, rng: random.Random) -> bytes:
    """2 to 20 wrong bits anywhere."""
    for _ in range(rng.randrange(2, 21)):
        log = flip(log, rng)
    return log


def lose(log: bytes, rng: random.Random) -> bytes:
    """Bytes are missing in the middle: a copy that skipped a buffer."""
    start = rng.randrange(len(log))
    return log[:start] + log[start + rng.randrange(1, 64 << 10) :]


def garble(log: bytes, rng: random.Random) -> bytes:
    """Up to 64 kB hold another part of the same log: a file system that mixed up its blocks."""
    length = rng.randrange(1, 64 << 10)
    start, other = rng.randrange(len(log) - length), rng.randrange(len(log) - length)
    return log[:start] + log[other : other + length] + log[start + length :]


def cut_and_zero(log: bytes, rng: random.Random) -> bytes:
    """Power loss with a hole before the end."""
    return zero(cut(log, rng), rng)


def flip_front(log: bytes, rng: random.Random) -> bytes:
    """One wrong bit where structure is dense: the first or the last 3 kB."""
    damaged = bytearray(log)
    damaged[rng.choice((1, -1)) * rng.randrange(1, 3000)] ^= 1 << rng.randrange(8)
    return bytes(damaged)


KINDS: dict[str, Damage] = {"cut": cut, "flip": flip, "zero": zero}
HARD_KINDS: dict[str, Damage] = {
    "flip many": flip_many,
    "lose": lose,
    "garble": garble,
    "cut and zero": cut_and_zero,
    "flip structure": flip_front,
}


@dataclass
class Tally:
    """Results of one kind of damage."""

    cases: int = 0
    crashes: int = 0
    wrong: int = 0
    """Messages that are not in the original, or more often than there."""
    disordered: int = 0
    """Messages yielded too late and not counted as such."""
    refused: int = 0
    """Files in which nothing looked like MCAP any more."""
    shares: list[float] = field(default_factory=list)
    whole_shares: list[float] = field(default_factory=list)
    """Recovered, relative to the messages in chunks of which no byte was touched."""
    baseline_shares: list[float] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)


def fingerprints(path: Path) -> Counter[Fingerprint]:
    """What is in a sound log, by the `mcap` package: the second witness."""
    with path.open("rb") as stream:
        return Counter(_fingerprint(*entry) for entry in make_reader(stream, validate_crcs=True).iter_messages())


def _fingerprint(schema: Schema | None, channel: Channel, message: Message) -> Fingerprint:
    name = schema.name if schema else ""
    return channel.topic, name, message.log_time, message.sequence, message.data


def chunks_of(data: bytes) -> list[tuple[bytes, int]]:
    """(the chunk's bytes, its number of messages) for every chunk of a sound log."""
    chunks, position = [], len(MCAP0_MAGIC)
    for record in StreamReader(io.BytesIO(data), emit_chunks=True).records:
        end = position + 9 + int.from_bytes(data[position + 1 : position + 9], "little")
        if isinstance(record, Chunk):
            messages = sum(isinstance(each, Message) for each in breakup_chunk(record))
            chunks.append((data[position:end], messages))
        position = end
    return chunks


def read_damaged(path: Path, originals: Counter[Fingerprint], tally: Tally) -> None:
    """Read a damaged file and add to the tally what came out of it."""
    found: Counter[Fingerprint] = Counter()
    latest, out_of_order = 0, 0
    reader = LogReader([path])
    for message in reader.messages():
        channel = message.channel
        found[channel.topic, channel.schema_name, message.log_time, message.sequence, message.data] += 1
        out_of_order += message.log_time < latest
        latest = max(latest, message.log_time)
    tally.wrong += sum((found - originals).values())
    tally.disordered += out_of_order - reader.losses.late_messages
    tally.shares.append(sum((found & originals).values()) / max(1, sum(originals.values())))


def baseline_share(data: bytes, originals: Counter[Fingerprint]) -> float:
    """Share of right messages from the better of the two readers of `mcap`, checksums on, until they raise."""
    return max(_share_until_failure(read(data), originals) for read in (_seeking, _streaming))


def _share_until_failure(messages: Iterator[Fingerprint], originals: Counter[Fingerprint]) -> float:
    found: Counter[Fingerprint] = Counter()
    try:
        for fingerprint in messages:
            found[fingerprint] += 1
    except Exception:  # whatever stops the baseline, it has what it has
        pass
    return sum((found & originals).values()) / max(1, sum(originals.values()))


def _seeking(data: bytes) -> Iterator[Fingerprint]:
    for entry in make_reader(io.BytesIO(data), validate_crcs=True).iter_messages():
        yield _fingerprint(*entry)


def _streaming(data: bytes) -> Iterator[Fingerprint]:
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    for record in StreamReader(io.BytesIO(data), validate_crcs=True, record_size_limit=1 << 30).records:
        if isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, Channel):
            channels[record.id] = record
        elif isinstance(record, Message):
            channel = channels[record.channel_id]
            yield _fingerprint(schemas.get(channel.schema_id), channel, record)


def run_cases(
    logs: Sequence[Path], kinds: dict[str, Damage], cases: int, seed: int, *, baseline: bool = False
) -> dict[str, Tally]:
    """Damage the logs `cases` times, kinds and logs taking turns; case N is the same for every run with this seed."""
    tallies = {name: Tally() for name in kinds}
    sound = [(path.read_bytes(), fingerprints(path), chunks_of(path.read_bytes())) for path in logs]
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "damaged.mcap"
        for case in range(cases):
            name = list(kinds)[case % len(kinds)]
            data, originals, chunks = sound[case // len(kinds) % len(sound)]
            damaged = kinds[name](data, random.Random(f"{seed}-{case}"))
            target.write_bytes(damaged)
            _run_case(target, originals, tallies[name], f"seed {seed} case {case} ({name})")
            whole = sum(count for chunk, count in chunks if chunk in damaged)
            if whole:
                tallies[name].whole_shares.append(tallies[name].shares[-1] * sum(originals.values()) / whole)
            if baseline:
                tallies[name].baseline_shares.append(baseline_share(damaged, originals))
    return tallies


def _run_case(path: Path, originals: Counter[Fingerprint], tally: Tally, name: str) -> None:
    tally.cases += 1
    wrong = tally.wrong
    try:
        read_damaged(path, originals, tally)
    except SemslamError:
        tally.refused += 1
        tally.shares.append(0.0)
    except Exception as error:
        tally.crashes += 1
        tally.shares.append(0.0)
        tally.failures.append(f"{name}: {type(error).__name__}: {error}")
    if tally.wrong > wrong:
        tally.failures.append(f"{name}: {tally.wrong - wrong} wrong messages")


def report(tallies: dict[str, Tally]) -> str:
    """A table, one line a kind and one for all."""
    lines = [
        f"{'KIND':16}{'CASES':>6}{'WRONG':>7}{'CRASHES':>9}{'REFUSED':>9}{'MEAN':>8}{'WORST':>8}{'WHOLE':>8}{'mcap':>8}{'RATIO':>8}"
    ]
    lines += [_line(name, [tally]) for name, tally in tallies.items()]
    return "\n".join([*lines, _line("all", list(tallies.values()))])


def _line(name: str, tallies: Sequence[Tally]) -> str:
    shares = [share for tally in tallies for share in tally.shares] or [0.0]
    baseline = [share for tally in tallies for share in tally.baseline_shares]
    mean = sum(shares) / len(shares)
    whole = [share for tally in tallies for share in tally.whole_shares] or [0.0]
    counts = [sum(getattr(tally, what) for tally in tallies) for what in ("cases", "wrong", "crashes", "refused")]
    versus = f"{'-':>8}{'-':>8}"
    if baseline and sum(baseline):
        versus = f"{sum(baseline) / len(baseline):8.1%}{mean * len(baseline) / sum(baseline):8.2f}"
    figures = f"{mean:8.1%}{min(shares):8.1%}{sum(whole) / len(whole):8.1%}"
    return f"{name:16}{counts[0]:6}{counts[1]:7}{counts[2]:9}{counts[3]:9}{figures}{versus}"


def machine() -> str:
    """Where and when these figures were taken."""
    versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in ("semslam", "mcap"))
    today = datetime.datetime.now(datetime.UTC).date()
    return f"{platform.machine()} {platform.system()}, Python {platform.python_version()}, {versions}, {today}"


def make_logs(folder: Path, frames: int) -> list[Path]:
    """One log for every compression that recorders use."""
    paths = []
    for compression in (CompressionType.ZSTD, CompressionType.LZ4, CompressionType.NONE):
        path = folder / f"{compression.name.lower()}.mcap"
        make_log(path, compression=compression, frames=frames)
        paths.append(path)
    return paths


def main() -> int:
    """Exit code 1 when a wrong message got through or anything crashed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=500)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--log", type=Path, action="append", help="a sound log to damage instead of made ones")
    parser.add_argument("--hard", action="store_true", help="add damage beyond cuts, flips and zeroed blocks")
    parser.add_argument("--quick", action="store_true", help="a few cases, to exercise the code path")
    options = parser.parse_args()
    cases, frames = (18, 12) if options.quick else (options.cases, 120)
    kinds = KINDS | (HARD_KINDS if options.hard else {})
    with tempfile.TemporaryDirectory() as folder:
        logs = options.log or make_logs(Path(folder), frames)
        print(f"damage: {cases} cases, seed {options.seed}, {', '.join(path.name for path in logs)}; {machine()}")
        tallies = run_cases(logs, kinds, cases, options.seed, baseline=True)
    print(report(tallies))
    print("MEAN, WORST: share of the messages recovered. WHOLE: the same, of the messages in chunks left untouched.")
    print("mcap: the better of that package's two readers, checksums on, until it raises. RATIO: MEAN to it.")
    for tally in tallies.values():
        print("\n".join(tally.failures[:10]), end="\n" if tally.failures else "")
    return int(any(tally.wrong or tally.crashes or tally.disordered for tally in tallies.values()))


if __name__ == "__main__":
    sys.exit(main())
