"""Colour and depth images that belong together: each colour image with the depth image nearest in time.

Streaming and bounded: a colour image waits only until no nearer depth image can come.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field

from semslam.logs.messages import CompressedImage, Image

_WAIT_NANOS = 2_000_000_000
"""A colour image without a partner is given up when log time has moved on by this much."""
_MAX_WAITING = 256


@dataclass(frozen=True, slots=True)
class Stamped:
    """An image message with its corrected stamp."""

    stamp_nanos: int
    log_time_nanos: int
    message: Image | CompressedImage


@dataclass
class PairBuffer:
    """Push images in log order, take pairs in stamp order.

    Attributes:
        tolerance_nanos: largest stamp difference of a pair.
        unpaired: colour images given up so far.
        disordered: images dropped because their stamp does not rise.
    """

    tolerance_nanos: int
    unpaired: int = 0
    disordered: int = 0
    _colour: deque[Stamped] = field(default_factory=deque)
    _depth: deque[Stamped] = field(default_factory=deque)
    _last: dict[str, int] = field(default_factory=dict)

    def push(self, role: str, image: Stamped) -> Iterator[tuple[Stamped, Stamped]]:
        """Add an image (`role` is colour or depth) and take the pairs that are settled by it."""
        if image.stamp_nanos <= self._last.get(role, -(2**63)):
            self.disordered += 1
            return
        self._last[role] = image.stamp_nanos
        (self._colour if role == "colour" else self._depth).append(image)
        yield from self._settled(image.log_time_nanos, ended=False)

    def finish(self) -> Iterator[tuple[Stamped, Stamped]]:
        """The pairs still waiting at the end of the log."""
        yield from self._settled(0, ended=True)

    def _settled(self, now_nanos: int, *, ended: bool) -> Iterator[tuple[Stamped, Stamped]]:
        while self._colour:
            colour = self._colour[0]
            late = now_nanos - colour.log_time_nanos > _WAIT_NANOS or len(self._colour) > _MAX_WAITING
            passed = bool(self._depth) and self._depth[-1].stamp_nanos >= colour.stamp_nanos + self.tolerance_nanos
            exact = any(depth.stamp_nanos == colour.stamp_nanos for depth in self._depth)
            if not (ended or late or passed or exact):
                break
            self._colour.popleft()
            partner = self._partner(colour)
            if partner is None:
                self.unpaired += 1
            else:
                yield colour, partner
        self._drop_old_depth()

    def _partner(self, colour: Stamped) -> Stamped | None:
        near = [d for d in self._depth if abs(d.stamp_nanos - colour.stamp_nanos) <= self.tolerance_nanos]
        return min(near, key=lambda d: (abs(d.stamp_nanos - colour.stamp_nanos), d.stamp_nanos), default=None)

    def _drop_old_depth(self) -> None:
        floor = self._colour[0].stamp_nanos if self._colour else self._last.get("colour", -(2**63))
        while self._depth and self._depth[0].stamp_nanos < floor - self.tolerance_nanos:
            self._depth.popleft()
        while len(self._depth) > _MAX_WAITING:
            self._depth.popleft()
