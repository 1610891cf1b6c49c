"""What a data set of simulated homes consists of: its recipe, its logs, and what determines every byte of a log.

A log depends on its own `Recording` alone, never on how many others there are, so that a data set can grow. Imports
nothing heavy: planning is free.
"""

from __future__ import annotations

import difflib
import hashlib
import importlib.metadata
import json
import math
import platform
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from functools import cache
from typing import Any

import semslam
from semslam.errors import UsageError

SIM_VERSION = 1
"""Raise it whenever the same recording comes out differently: finished logs of the old version are then refused."""

VARIANTS = ("standard", "plain", "repeating", "symmetric", "rooms", "person")
NOISES = ("none", "half", "standard", "triple")
_PREFIXES = {"standard": "home"}
_LIBRARIES = (
    "mujoco",
    "mujoco-warp",
    "warp-lang",
    "numpy",
    "opencv-contrib-python-headless",
    "mcap",
    "pyarrow",
    "zstandard",
)
_HOMES_A_SEED, _DAYS_A_HOME, _DRIVES_A_DAY = 1000, 2, 100
"""Strides of seeds. Never change them: homes are known by their seeds. No limit below may exceed its stride."""
_MOST = {"scenes": 1000, "trajectories": 100, "days": 2, "steps": 100_000}
_FASTEST_HZ, _SLOWEST_HZ = 10.0, 0.01
_LONGEST_S = 6 * 3600
_SMALLEST_PX, _LARGEST_PX = 32, 4096
_LARGEST_SEED = 2**31 - 1


@dataclass(frozen=True)
class Recipe:
    """Parameters of a data set.

    Raises:
        UsageError: a value makes no data set.
    """

    scenes: int = 30
    """Homes of every variant, 1 to 1000."""
    trajectories: int = 3
    """Logs of every home and day, 1 to 100."""
    steps: int = 80
    """Keyframes of a log."""
    seed: int = 1
    """Of everything random, 0 or more."""
    variants: tuple[str, ...] = ("standard",)
    """Kinds of homes, of `VARIANTS`; home 3 of one variant has the seed of home 3 of any other."""
    days: int = 1
    """2 records every home again after somebody moved furniture."""
    rate_hz: float = 1.0
    """Most keyframes a second; intervals are up to a quarter longer."""
    noise: str = "standard"
    """Of wheels and IMU, one of `NOISES`."""
    width: int = 640
    """Columns of the pictures."""
    height: int = 480
    """Rows of the pictures."""

    def __post_init__(self) -> None:
        for name, most in _MOST.items():
            _require_number(f"--{name}", getattr(self, name), 1, most)
        _require_number("--seed", self.seed, 0, _LARGEST_SEED)
        _require_number("--rate", self.rate_hz, _SLOWEST_HZ, _FASTEST_HZ)
        hours = self.steps / self.rate_hz / 3600
        if hours * 3600 > _LONGEST_S:
            raise UsageError(
                f"`--steps {self.steps}` at `--rate {self.rate_hz:.15g}` are {hours:.1f} hours of driving",
                hint=f"a log lasts {_LONGEST_S // 3600} hours at most: fewer `--steps`, or a higher `--rate`",
            )
        _require_name("--noise", self.noise, NOISES)
        for variant in self.variants or ("",):
            _require_name("--variant", variant, VARIANTS)
        for pixels in (self.width, self.height):
            _require_number("--size", pixels, _SMALLEST_PX, _LARGEST_PX)
        object.__setattr__(self, "variants", tuple(name for name in VARIANTS if name in self.variants))
        object.__setattr__(self, "rate_hz", float(self.rate_hz))

    def recordings(self) -> list[Recording]:
        """All logs, by variant, scene, day and trajectory."""
        return [
            self._recording(variant, scene, day, trajectory)
            for variant in self.variants
            for scene in range(self.scenes)
            for day in range(self.days)
            for trajectory in range(self.trajectories)
        ]

    def _recording(self, variant: str, scene: int, day: int, trajectory: int) -> Recording:
        home_seed = self.seed * _HOMES_A_SEED + scene
        the_day = f"_d{day}" if self.days > 1 else ""
        return Recording(
            f"{_PREFIXES.get(variant, variant)}_{scene:02}{the_day}_t{trajectory}",
            variant,
            scene,
            day,
            trajectory,
            home_seed,
            (home_seed * _DAYS_A_HOME + day) * _DRIVES_A_DAY + trajectory,
            self.steps,
            self.rate_hz,
            self.noise,
            self.width,
            self.height,
        )


@dataclass(frozen=True)
class Recording:
    """One log of a data set: everything that makes it what it is, beside the versions of the software."""

    name: str
    variant: str
    scene: int
    """Number of the home within its variant."""
    day: int
    trajectory: int
    home_seed: int
    """Of the home and of the robot that lives there."""
    drive_seed: int
    """Of the route, of the noise and of the clock."""
    steps: int
    rate_hz: float
    noise: str
    width: int
    height: int

    def key(self) -> str:
        """SHA-256 of the recording and of the versions that record it."""
        text = json.dumps({"recording": asdict(self), "versions": versions()}, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()


@cache
def versions() -> dict[str, str]:
    """Of the software that determines the content of a log."""
    found = {"semslam": semslam.__version__, "simulator": str(SIM_VERSION), "processor": platform.machine()}
    for name in _LIBRARIES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:  # another distribution of the same module
            found[name] = "unknown"
    return found


def size_of(text: str) -> tuple[int, int]:
    """Width and height of `640x480`.

    Raises:
        UsageError: it is not of that form.
    """
    match = re.fullmatch(r"(\d{1,6})[xX](\d{1,6})", text)
    if match is None:
        raise UsageError(f"`--size {text}` is not of the form WIDTHxHEIGHT", hint="`--size 640x480`")
    return int(match[1]), int(match[2])


def differences(stored: Mapping[str, Any], recipe: Recipe) -> list[str]:
    """What keeps a stored data set from growing into one of this recipe; empty if nothing does.

    `stored` is `{"recipe": ..., "versions": ...}`. More scenes, trajectories or variants only add logs.
    """
    old, new = dict(stored["recipe"]), as_json(recipe)
    found = [_change(name, old.get(name), new[name]) for name in new if not _grows(name, old.get(name), new[name])]
    before, now = dict(stored["versions"]), versions()
    found += [
        _change(name, before.get(name), now.get(name))
        for name in sorted({*before, *now})
        if before.get(name) != now.get(name)
    ]
    return found


def as_json(recipe: Recipe) -> dict[str, Any]:
    """The recipe as plain values, as JSON gives them back."""
    values = {field.name: getattr(recipe, field.name) for field in fields(recipe)}
    return {**values, "variants": list(recipe.variants)}


def _grows(name: str, old: Any, new: Any) -> bool:
    if name in ("scenes", "trajectories") and isinstance(old, int):
        return old <= int(new)
    if name == "variants" and isinstance(old, list):
        return set(old) <= set(new)
    return bool(old == new)


def _change(name: str, old: Any, new: Any) -> str:
    before, after = (", ".join(x) if isinstance(x, list) else "missing" if x is None else str(x) for x in (old, new))
    return f"{name}  {before} -> {after}"


def _require_number(option: str, value: float, least: float, most: float) -> None:
    if not (math.isfinite(value) and least <= value <= most):
        raise UsageError(
            f"`{option} {value:.15g}` makes no data set", hint=f"`{option}` takes {least:.15g} to {most:.15g}"
        )


def _require_name(option: str, name: str, names: Sequence[str]) -> None:
    if name not in names:
        close = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
        hint = f"did you mean `{option} {close[0]}`?" if close else f"one of {', '.join(names)}"
        raise UsageError(f"There is no `{option} {name}`", hint=hint)
