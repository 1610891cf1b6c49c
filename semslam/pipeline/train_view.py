"""What a person sees of `semslam train`: a bar, or plain lines in a pipe."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from semslam.pipeline.console import Console

if TYPE_CHECKING:
    from tqdm import tqdm

_LINE_PERIOD_S = 20.0


class _View:
    """A bar over a number of things on a terminal, a line now and then elsewhere."""

    def __init__(self, console: Console, unit: str) -> None:
        self._console, self._unit = console, unit
        self._bar: tqdm[Any] | None = None
        self._said = time.monotonic() - _LINE_PERIOD_S

    def show(self, done: int, total: int, text: str = "") -> None:
        """So many of so many are done."""
        if self._console.quiet:
            return
        if self._console.terminal:
            self._move(done, total, text)
        elif time.monotonic() - self._said >= _LINE_PERIOD_S or done == total:
            self._said = time.monotonic()
            self._console.say(f"{done:,}/{total:,} {self._unit}s {text}".rstrip())

    def close(self) -> None:
        """Take the bar away, whatever ended the command."""
        if self._bar is not None:
            self._bar.close()

    def _move(self, done: int, total: int, text: str) -> None:
        if self._bar is None:
            from tqdm import tqdm

            self._bar = tqdm(
                total=total,
                unit=f" {self._unit}",
                initial=done,
                leave=False,
                file=self._console.stream,
                dynamic_ncols=True,
            )
        self._bar.set_postfix_str(text, refresh=False)
        self._bar.update(done - self._bar.n)


class PicturesView(_View):
    """Homes being drawn."""

    def __init__(self, console: Console) -> None:
        super().__init__(console, "home")

    def progressed(self, done: int, homes: int) -> None:
        """So many homes are drawn."""
        self.show(done, homes)


class LogsView(_View):
    """Logs of a data set being read."""

    def __init__(self, console: Console) -> None:
        super().__init__(console, "log")

    def progressed(self, done: int, logs: int) -> None:
        """So many logs are read."""
        self.show(done, logs)


class TrainingView(_View):
    """A network being trained."""

    def __init__(self, console: Console) -> None:
        super().__init__(console, "step")

    def progressed(self, progress: Any) -> None:
        """So many steps are done, with these losses."""
        losses = "  ".join(f"{name} {value:.3f}" for name, value in progress.losses.items())
        left_s = (progress.steps - progress.step) / max(progress.steps_per_s, 1e-6)
        self.show(
            progress.step, progress.steps, f"{losses}  {progress.steps_per_s:.2f} step/s, {left_s / 60:,.0f} min left"
        )


def say_pictures(console: Console, report: Any) -> None:
    """What a set of views came to."""
    there = f", {report.cached} were there already" if report.cached else ""
    console.say(f"{report.done} homes drawn{there}: {report.out}")
    for seed, reason in sorted(report.failures.items()):
        console.say(f"home {seed} failed: {reason}")
