"""What a person sees of `semslam simulate`: a bar over frames, or plain lines in a pipe, and a table at the end."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from semslam.errors import SemslamError
from semslam.pipeline.console import MAX_LINES, Console, bytes_text, table

if TYPE_CHECKING:
    from tqdm import tqdm

_LINE_PERIOD_S = 10.0
_HEAD = ("HOMES", "LOGS", "CACHED", "DONE", "FAILED", "FRAMES", "OBJECTS A FRAME", "FRAMES PER CPU-S", "SIZE")


class SimulateView:
    """Shows a data set being made (the simulator's `Listener`)."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._bar: tqdm[Any] | None = None
        self._logs = self._settled = self._frames = self._done = 0
        self._start = self._said = time.monotonic()

    def planned(self, logs: int, cached: int, frames: int) -> None:
        """Say how much there is to do."""
        self._logs, self._settled, self._frames = logs, cached, frames
        self._start = self._said = time.monotonic()
        there = f", {cached} finished already" if cached else ""
        self._console.say(f"{logs} logs{there}; {frames:,} frames to make")
        if frames and self._console.terminal and not self._console.quiet:
            from tqdm import tqdm  # only a command with something to do pays for the import

            self._bar = tqdm(
                desc=self._text(),
                unit=" frame",
                total=frames,
                leave=False,
                file=self._console.stream,
                dynamic_ncols=True,
            )

    def progressed(self, frames: int) -> None:
        """Move the bar."""
        self._done = frames
        if self._bar is not None:
            self._bar.update(frames - self._bar.n)

    def settled(self, result: Any) -> None:
        """Count the log; a failure is told at once."""
        self._settled += 1
        if self._bar is not None:
            self._bar.set_description(self._text())
        elif result.state == "failed":
            self._console.say(f"{result.recording.name}: failed")

    def tick(self) -> None:
        """Let the time go on; in a pipe, a line every ten seconds."""
        if self._bar is not None:
            self._bar.refresh()
        elif (now := time.monotonic()) - self._said >= _LINE_PERIOD_S:
            self._said = now
            self._console.say(f"{self._text()}, {self._pace(now - self._start)}")

    def close(self) -> None:
        """Take the bar away, whatever ended the command."""
        if self._bar is not None:
            self._bar.close()

    def _text(self) -> str:
        return f"{self._settled}/{self._logs} logs"

    def _pace(self, passed_s: float) -> str:
        """How far, how fast, and how long still."""
        rate = self._done / max(passed_s, 1e-3)
        left = f", {(self._frames - self._done) / rate:,.0f} s left" if rate > 0 else ""
        return f"{self._done:,}/{self._frames:,} frames, {rate:.2f} frame/s{left}"


def say_simulated(console: Console, report: Any) -> None:
    """The last lines: a row for every kind of home, what was noticed, what failed, where to go on."""
    variants = list(dict.fromkeys(one.recording.variant for one in report.results))
    rows = [_row(name, [one for one in report.results if one.recording.variant == name], report) for name in variants]
    whole = [_row("all", report.results, report)] if len(variants) > 1 else []
    console.say(table([_HEAD, *rows, *whole]))
    console.say(f"wall time: {report.wall_s:,.1f} s")
    for note in report.notes:
        console.warn(note)
    _say_failures(console, report.failures)
    console.say(f"logs: {report.out / 'logs'}")


def _say_failures(console: Console, failures: Sequence[Any]) -> None:
    """Every reason once, with the logs that it cost."""
    reasons: dict[Any, list[str]] = {}
    for one in failures:
        reasons.setdefault(one.failure, []).append(one.recording.name)
    for failure, names in list(reasons.items())[:MAX_LINES]:
        others = f" and {len(names) - 1} more" if len(names) > 1 else ""
        message = f"`{names[0]}`{others}: {failure.message}"
        console.error(SemslamError(message, hint=failure.hint, details=failure.details))
    if len(reasons) > MAX_LINES:
        console.line(f"and {len(reasons) - MAX_LINES} other reasons; `--json` lists them")


def _row(name: str, results: Sequence[Any], report: Any) -> list[str]:
    """One kind of home; objects as median (least)."""
    counts = report.summary(results)
    median, least, rate = counts.objects_median, counts.objects_min, counts.frames_per_cpu_s
    return [
        name,
        str(len(results)),
        *(str(counts.states[state]) for state in ("cached", "done", "failed")),
        f"{counts.frames:,}",
        "-" if median is None else f"{median:g} ({least})",
        "-" if rate is None else f"{rate:.2f}",
        bytes_text(counts.bytes),
    ]
