"""What ingest costs beside the bare libraries under it, and how much memory it takes. Extract has `extract_share.py`.

    python benchmarks/stages.py [LOG] [--quick]

Without a log, the demo's. Every figure is CPU time of a process of its own, imports included, and a ratio to a
baseline process on the same input in the same run:

- ingest (all pairs, a keyframe a second) against `mcap` with its ROS 2 decoder and `cv2.imdecode` of every image;
- peak memory of ingest on logs of 100 MB and 1 GB, beside that of importing the same libraries.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from machine import machine

from semslam.logs.messages import CameraInfo, Image, Imu
from semslam.logs.writer import Ros2LogWriter
from semslam.pipeline.demo import demo_log
from semslam.pipeline.threads import ONE_THREAD

_DECODE = """
import sys, cv2, numpy as np
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
pixels = 0
with open(sys.argv[1], "rb") as file:
    for _, channel, _, message in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
        if hasattr(message, "format"):
            start = 12 if "compressedDepth" in message.format else 0
            pixels += cv2.imdecode(np.frombuffer(message.data, np.uint8)[start:], cv2.IMREAD_UNCHANGED).size
print(pixels)
"""

_IMPORT = "import numpy, cv2, pyarrow.parquet, semslam.stages.ingest"


@dataclass(frozen=True)
class Cost:
    """Of one process."""

    cpu_s: float
    wall_s: float
    peak_mb: float


def measure(command: Sequence[str]) -> Cost:
    """Run a command with one thread for every library; its own CPU time, wall time and peak memory."""
    start = time.perf_counter()
    pid = os.posix_spawn(
        command[0],
        list(command),
        {**os.environ, **ONE_THREAD},
        file_actions=[(os.POSIX_SPAWN_OPEN, 1, os.devnull, os.O_WRONLY, 0)],
    )
    _, status, usage = os.wait4(pid, 0)
    if status:
        sys.exit(f"failed: {' '.join(command)}")
    return Cost(usage.ru_utime + usage.ru_stime, time.perf_counter() - start, usage.ru_maxrss / 1024)


def semslam(*words: str) -> list[str]:
    """A semslam command that does everything in its own process."""
    return [sys.executable, "-m", "semslam.pipeline.cli", *words, "--workers", "0", "--quiet"]


def python(code: str, *words: str) -> list[str]:
    """A Python process."""
    return [sys.executable, "-c", code, *words]


def ratio(name: str, cost: Cost, baseline: Cost, what: str) -> None:
    """Print one figure."""
    print(f"{name:<28} {cost.cpu_s:7.2f} s CPU   {cost.cpu_s / baseline.cpu_s:5.2f} x {what} ({baseline.cpu_s:.2f} s)")


def ingest(log: Path, folder: Path) -> None:
    """Ingest against bare decoding."""
    baseline = measure(python(_DECODE, str(log)))
    what = "mcap + cv2.imdecode"
    ratio("ingest, keyframe a second", measure(semslam("ingest", str(log), "--out", str(folder / "a"))), baseline, what)
    every = semslam("ingest", str(log), "--out", str(folder / "b"), "--set", "ingest.period_s=0")
    ratio("ingest, every pair", measure(every), baseline, what)


def big_log(path: Path, megabytes: int) -> None:
    """A log of raw pictures that do not compress, 30 pairs a second, with an IMU."""
    rng = np.random.default_rng(0)
    width, height = 640, 480
    colour = rng.integers(0, 256, (height, width, 3), np.uint8).tobytes()
    depth = rng.integers(500, 4000, (height, width), np.uint16).tobytes()
    k = (500.0, 0.0, 320.0, 0.0, 500.0, 240.0, 0.0, 0.0, 1.0)
    info = CameraInfo(0, "cam", width, height, "plumb_bob", (0.0,) * 5, k, (1.0, 0, 0, 0, 1, 0, 0, 0, 1), (0.0,) * 12)
    pairs = megabytes * 1_000_000 // (len(colour) + len(depth))
    with Ros2LogWriter(path, compression="none") as log:
        for pair in range(pairs):
            stamp = 1_700_000_000_000_000_000 + pair * 33_333_333
            log.write("/color/camera_info", info, stamp)
            log.write("/color/image", Image(stamp, "cam", height, width, "rgb8", 3 * width, False, colour), stamp)
            log.write("/depth/image", Image(stamp, "cam", height, width, "16UC1", 2 * width, False, depth), stamp)
            log.write("/imu", Imu(stamp, "cam", (0.0, 0.0, 0.0), (0.0, -9.81, 0.0), None), stamp)


def memory(folder: Path, sizes: Sequence[int]) -> None:
    """Peak memory of ingest by size of the log."""
    idle = measure(python(_IMPORT))
    print(f"{'imports alone':<28} {idle.peak_mb:7.0f} MB peak")
    for size in sizes:
        log = folder / f"big_{size}.mcap"
        big_log(log, size)
        cost = measure(semslam("ingest", str(log), "--out", str(folder / f"out_{size}")))
        print(
            f"{f'ingest of {log.stat().st_size / 1e6:,.0f} MB':<28} {cost.peak_mb:7.0f} MB peak   {cost.wall_s:.1f} s"
        )
        log.unlink()


def main() -> None:
    """Parse and run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log", nargs="?", type=Path)
    parser.add_argument("--quick", action="store_true", help="small inputs: only to see that it runs")
    args = parser.parse_args()
    print(machine("mcap", "mcap-ros2-support", "opencv-contrib-python-headless", "numpy"))
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        ingest(args.log or demo_log(), folder)
        memory(folder, [20] if args.quick else [100, 1000])


if __name__ == "__main__":
    main()
