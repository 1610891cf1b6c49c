"""What the commands that learn from the drives of a data set have in common."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from semslam.models.training.trainer import Schedule


@dataclass(frozen=True, kw_only=True)
class DrivesRequest:
    """What such a command asks for; None means the value of the shipped model."""

    dataset: Path
    out: Path
    run_folder: Path | None = None
    protocol: str = "cross"
    steps: int | None = None
    batch: int | None = None
    rate: float | None = None
    seed: int = 1
    threads: int = 1
    device: str = "auto"

    def schedule_from(self, usual: Schedule) -> Schedule:
        """How long and how fast."""
        return replace(
            usual,
            steps=self.steps or usual.steps,
            batch=self.batch or usual.batch,
            peak_rate=self.rate or usual.peak_rate,
            seed=self.seed,
        )

    def typed(self, task: str, schedule: Schedule, options: str) -> str:
        """What to type to make it again, without folders of this machine; `options` are the command's own."""
        run = f" --run {self.run_folder.name}" if self.run_folder else ""
        return (
            f"semslam train {task} {self.dataset.name}{run} --out {self.out.name} {options} --steps {schedule.steps} "
            f"--batch {schedule.batch} --rate {schedule.peak_rate:g} --seed {schedule.seed} --threads {self.threads}"
        )
