"""Training: it learns, it survives a kill to the bit, it refuses to mix runs, and its exports equal torch."""

from __future__ import annotations

import csv
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the extra [train]")
pytest.importorskip("onnxscript", reason="needs the extra [train]")

from semslam.errors import SemslamError  # noqa: E402
from semslam.models.detectors import Detector as OpenDetector  # noqa: E402
from semslam.models.nets.detector import Detector, DetectorShape, Exported, cells  # noqa: E402
from semslam.models.training.curriculum import size_at  # noqa: E402
from semslam.models.training.detector import SIZES, Batches, Examples, assign, generalised_iou  # noqa: E402
from semslam.models.training.pictures import CLASSES, PictureSet  # noqa: E402
from semslam.models.training.runs import TASKS, asked, new_detector, train_detector, trained_detector  # noqa: E402
from semslam.models.training.trainer import CHECKPOINT, Schedule, fit, read_checkpoint  # noqa: E402
from tests.views_factory import NAMES, write_views  # noqa: E402

STEPS = 6


def tiny_fit(folder: Path, *, stop_at: int | None = None, seed: int = 1) -> Any:
    """A line through noisy points; the batch of step `stop_at` never comes."""

    def batch_of(step: int) -> Any:
        if step == stop_at:
            raise KeyboardInterrupt
        generator = torch.Generator().manual_seed(step)
        x = torch.rand(16, 1, generator=generator)
        return x, 3 * x + 1

    def loss(network: Any, batch: Any) -> Any:
        value = ((network(batch[0]) - batch[1]) ** 2).mean()
        return value, {"error": float(value.detach())}

    torch.manual_seed(seed)
    network = torch.nn.Linear(1, 1)
    timing = {"checkpoint_s": 0.0, "report_every": 10}
    schedule = Schedule(steps=40, batch=16, seed=seed, peak_rate=0.1, warm_up=5, average=0.5, **timing)
    return fit(network, loss, batch_of, schedule, folder, facts={"task": "line"})


def test_a_killed_run_goes_on_as_if_nothing_had_happened(tmp_path: Path) -> None:
    """Stopped at step 23 and started again: the same weights, and curves without gaps or repeats."""
    whole = tiny_fit(tmp_path / "whole")
    with pytest.raises(KeyboardInterrupt):
        tiny_fit(tmp_path / "cut", stop_at=23)
    assert 0 < read_checkpoint(tmp_path / "cut" / CHECKPOINT)["step"] < 40
    resumed = tiny_fit(tmp_path / "cut")
    for name, value in whole.state_dict().items():
        assert torch.equal(value, resumed.state_dict()[name])
    curves = (tmp_path / "cut" / "curves.csv").read_text()
    assert curves == (tmp_path / "whole" / "curves.csv").read_text()
    assert [row[0] for row in csv.reader(curves.splitlines())] == ["step", "10", "20", "30", "40"]


def test_it_learns(tmp_path: Path) -> None:
    """The line is found."""
    network = tiny_fit(tmp_path)
    assert network(torch.tensor([[0.5]])).item() == pytest.approx(2.5, abs=0.3)


def test_another_run_s_checkpoint_is_refused(tmp_path: Path) -> None:
    """A folder holds one run; the error says what differs."""
    tiny_fit(tmp_path)
    with pytest.raises(SemslamError, match="another run") as caught:
        tiny_fit(tmp_path, seed=2)
    assert "seed 1 -> 2" in (caught.value.details or "")


def test_a_damaged_checkpoint_is_one_clear_error(tmp_path: Path) -> None:
    """Half a file is no checkpoint."""
    tiny_fit(tmp_path)
    path = tmp_path / CHECKPOINT
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(SemslamError, match="cannot be read"):
        tiny_fit(tmp_path)


def test_a_loss_that_is_no_number_stops_the_run(tmp_path: Path) -> None:
    """Training on would write rubbish over good weights."""
    network, one = torch.nn.Linear(1, 1), torch.ones(1, 1)

    def loss(network: Any, batch: Any) -> Any:
        return network(batch).sum() * float("nan"), {}

    with pytest.raises(SemslamError, match="loss of step 0 is nan"):
        fit(network, loss, lambda _: one, Schedule(steps=3, batch=1), tmp_path, facts={})


def small_run(views: Path, out: Path, **more: Any) -> Any:
    return asked("detector", views=views, out=out, steps=STEPS, batch=2, threads=1, device="cpu", **more)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a short training on coloured boxes."""
    room = tmp_path_factory.mktemp("training")
    train_detector(small_run(write_views(room / "views"), room / "run"))
    return room / "run"


def test_a_trained_detector_opens_as_ours(trained: Path) -> None:
    """The export has the class names and is recognised without help."""
    detector = OpenDetector.open(trained / "detector.onnx")
    assert detector.class_names == NAMES
    assert detector.name == "semslam"


def test_the_export_equals_torch(trained: Path) -> None:
    """Same numbers from ONNX Runtime as from torch, for one picture and for three."""
    import onnxruntime

    network, names = trained_detector(trained)
    assert names == NAMES
    session = onnxruntime.InferenceSession(str(trained / "detector.onnx"), providers=["CPUExecutionProvider"])
    for count in (1, 3):
        images, depth = torch.rand(count, 3, 288, 384), torch.rand(count, 1, 288, 384) * 6
        found = session.run(None, {"images": images.numpy(), "depth": depth.numpy()})[0]
        with torch.no_grad():
            wanted = Exported(network)(images, depth).numpy()
        np.testing.assert_allclose(found, wanted, atol=2e-3, rtol=1e-4)  # pixels


def test_the_same_run_gives_the_same_bytes(trained: Path, tmp_path: Path) -> None:
    """Data, seed and steps decide the file."""
    again = train_detector(small_run(write_views(tmp_path / "views"), tmp_path / "run"))[0]
    assert again.read_bytes() == (trained / "detector.onnx").read_bytes()


def test_kill_9_costs_nothing_but_time(trained: Path, tmp_path: Path) -> None:
    """A real process killed amid its training, and the same command again: the same file."""
    views = write_views(tmp_path / "views")
    script = (
        "import sys, dataclasses; from pathlib import Path\n"
        "from semslam.models.training.runs import asked, train_detector\n"
        f"run = asked('detector', views=Path(sys.argv[1]), out=Path(sys.argv[2]), steps={STEPS}, batch=2, threads=1,"
        " device='cpu')\n"
        "schedule = dataclasses.replace(run.schedule, checkpoint_s=0.0, report_every=1)\n"
        "train_detector(dataclasses.replace(run, schedule=schedule))\n"
    )
    command = [sys.executable, "-c", script, str(views), str(tmp_path / "run")]
    process = subprocess.Popen(command, env={**os.environ, "OMP_NUM_THREADS": "1"})
    deadline = time.monotonic() + 120
    while not (tmp_path / "run" / CHECKPOINT).is_file() and time.monotonic() < deadline and process.poll() is None:
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    subprocess.run(command, check=True, env={**os.environ, "OMP_NUM_THREADS": "1"})
    assert (tmp_path / "run" / "detector.onnx").read_bytes() == (trained / "detector.onnx").read_bytes()
    assert not list((tmp_path / "run").glob(".*partial*")) or process.returncode != 0


def test_batches_depend_on_seed_and_step_alone(tmp_path: Path) -> None:
    """Resuming needs no history; sizes grow as training goes on."""
    views = PictureSet.open(write_views(tmp_path))
    one, two = (Batches.of(views, steps=100, batch=2, seed=3) for _ in range(2))
    two(7)
    first, second = one(50), two(50)
    assert torch.equal(first.images, second.images)
    assert first.images.shape[2:] == (size_at(SIZES, 0.5)[1], size_at(SIZES, 0.5)[0])
    assert not torch.equal(one(51).images, first.images)
    assert [size_at(SIZES, done) for done in (0.0, 0.99)] == [(256, 192), (384, 288)]


def test_an_object_is_answered_for_by_cells_inside_it() -> None:
    """Cells that answer lie in the box and asked for its class and sides; on a glimpse its class does not count."""
    centres, strides = cells(256, 192)
    boxes = torch.cat([centres - 20, centres + 20], 1)
    scores = torch.full((len(centres), 2), 0.01)
    truth = Examples(
        torch.tensor([[40.0, 40.0, 90.0, 90.0]]),
        torch.tensor([1]),
        torch.tensor([[150.0, 100.0, 200.0, 150.0]]),
        torch.tensor([0]),
    )
    wanted, goal, used = assign(boxes, scores, centres, strides, truth)
    answering = wanted.sum(1) > 0
    assert 1 <= int(answering.sum()) <= 10
    assert (centres[answering] > 40).all()
    assert (centres[answering] < 90).all()
    assert wanted[:, 0].sum() == 0
    assert (goal[answering] == truth.boxes[0]).all()
    glimpsed = ((centres > torch.tensor([150.0, 100.0])) & (centres < torch.tensor([200.0, 150.0]))).all(1)
    assert (used[glimpsed, 0] == 0).all()
    assert (used[glimpsed, 1] == 1).all()
    assert (used[~glimpsed] == 1).all()


def test_generalised_iou_of_known_boxes() -> None:
    """Equal boxes 1; boxes apart below 0, by the gap: worked by hand."""
    one = torch.tensor([[0.0, 0.0, 2.0, 2.0]])
    assert float(generalised_iou(one, one)) == pytest.approx(1.0)
    assert float(generalised_iou(one, torch.tensor([[2.0, 0.0, 4.0, 2.0]]))) == pytest.approx(0.0)
    assert float(generalised_iou(one, torch.tensor([[4.0, 0.0, 6.0, 2.0]]))) == pytest.approx(-4 / 12)


def test_the_network_is_small() -> None:
    """About a million parameters."""
    network = new_detector(CLASSES, 1)
    assert 0.5e6 < sum(value.numel() for value in network.parameters()) < 1.05e6
    raw = Detector(DetectorShape(3))(torch.rand(1, 3, 240, 320), torch.rand(1, 1, 240, 320))
    assert raw.shape == (1, 7, len(cells(320, 240)[0]))


def test_a_finished_run_leaves_a_card_with_what_it_is_worth(tmp_path: Path) -> None:
    """Data, seed, command, digest and average precision on views given for it."""
    import hashlib

    views, unseen = write_views(tmp_path / "views"), write_views(tmp_path / "unseen", first=7)
    pytest.importorskip("pycocotools", reason="needs the extra [train]")
    model, card = train_detector(small_run(views, tmp_path / "run", test=unseen))
    text = card.read_text()
    assert hashlib.sha256(model.read_bytes()).hexdigest() in text
    assert f"--steps {STEPS} --batch 2" in text
    assert "| **all** |" in text
    assert "| seed | 1 |" in text


@pytest.mark.parametrize("task", ["detector", "segmenter"])
def test_random_networks_are_exported_by_seed(task: str, tmp_path: Path) -> None:
    """`models export --random`: the same seed gives the same files, another one others."""
    one, two, three = (
        TASKS[task].export(tmp_path / name, None, seed, None) for name, seed in zip("abc", (1, 1, 2), strict=True)
    )
    assert [path.read_bytes() for path in one] == [path.read_bytes() for path in two]
    assert [path.read_bytes() for path in one] != [path.read_bytes() for path in three]


def test_homes_that_are_trained_on_are_no_test(tmp_path: Path) -> None:
    """Refused before the training begins, with what to type."""
    views = write_views(tmp_path / "views", homes=2)
    with pytest.raises(SemslamError, match="1 homes of") as caught:
        train_detector(small_run(views, tmp_path / "run", test=write_views(tmp_path / "test", first=1)))
    assert "--seed" in (caught.value.hint or "")
    assert not (tmp_path / "run").exists()


def test_another_task_s_run_is_not_exported(trained: Path, tmp_path: Path) -> None:
    """A detector's run makes no segmenter."""
    with pytest.raises(SemslamError, match="not the run of a segmenter"):
        TASKS["segmenter"].export(tmp_path, trained, None, None)


def test_a_checkpoint_with_flipped_bits_is_refused(tmp_path: Path) -> None:
    """Weights that changed on the disk are not trained on in silence."""
    tiny_fit(tmp_path)
    path = tmp_path / CHECKPOINT
    content = bytearray(path.read_bytes())
    for offset in range(len(content) // 2, len(content) // 2 + 64):
        content[offset] ^= 0x55
    path.write_bytes(content)
    with pytest.raises(SemslamError, match=r"cannot be read|another"):
        tiny_fit(tmp_path)


def test_a_checkpoint_of_another_shape_is_refused(tmp_path: Path) -> None:
    """As a newer semslam with another network would find it."""
    stored = tiny_fit(tmp_path) and read_checkpoint(tmp_path / CHECKPOINT)
    stored["network"] = {"weight": torch.zeros(3, 3), "bias": torch.zeros(3)}
    torch.save(stored, tmp_path / CHECKPOINT)
    with pytest.raises(SemslamError, match="another shape"):
        tiny_fit(tmp_path)


def test_one_training_at_a_time_in_a_folder(tmp_path: Path) -> None:
    """The second is refused before it writes anything."""
    import fcntl

    views, out = write_views(tmp_path / "views"), tmp_path / "run"
    out.mkdir()
    descriptor = os.open(out, os.O_RDONLY)
    fcntl.flock(descriptor, fcntl.LOCK_EX)
    with pytest.raises(SemslamError, match="Another training"):
        train_detector(small_run(views, out))
    os.close(descriptor)
    assert not list(out.iterdir())


def test_a_full_disk_is_told_as_such(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the disk says arrives as an OSError, which the command line knows how to tell; nothing half remains."""

    def full(self: Path, _data: Any) -> int:
        raise OSError(28, "No space left on device", str(self))

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="No space left"):
        tiny_fit(tmp_path)
    assert not list(tmp_path.glob(".*partial*"))
