"""A vocabulary for ORB-SLAM3 from the pictures of a finished run, for those who cannot have the original ORBvoc.txt.

    python benchmarks/orb_vocabulary.py RUN OUT.txt [--logs NAME ...] [--branches 10] [--levels 5] [--seed 1]
        [--descriptors 300000]

Reads   frames of the run    data_spec.md, table 2
Writes  OUT.txt              text format of DBoW2: `PYORBSLAM3_VOCAB=OUT.txt` makes the peer `pyorbslam3` use it

Whole pictures are taken evenly over all keyframes, so that document frequencies are those of real pictures. ORB
descriptors of 256 bits are split into groups around their bitwise majorities under Hamming distance, those again, and
so on; a leaf is a word, and weighs ln(pictures / pictures that show it). Name logs that train: a vocabulary made from
logs that test has seen their pictures.

Source: D. Galvez-Lopez and J. D. Tardos, "Bags of Binary Words for Fast Place Recognition in Image Sequences",
IEEE Transactions on Robotics 28(5), 2012, section III.
"""

from __future__ import annotations

import argparse
import sys
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.pipeline.run_tables import run_tables
from semslam.tables.parquet import TableFiles
from semslam.tables.pictures import decode_colour
from semslam.tables.spec import FRAMES

FEATURES, SCALE, OCTAVES, LEAST_CONTRAST = 1000, 1.2, 8, 7
"""Of ORB, as the peer `pyorbslam3` has them."""
_MOST_ROUNDS = 10
"""Most groups stand still by then; what moves afterwards is a few descriptors between two majorities."""
_L1_NORM, _TF_IDF = 0, 0
"""DBoW2's numbers of the score and the weights that ORB-SLAM3 is used with."""

Bytes = NDArray[np.uint8]
"""(N, 32) descriptors."""
Bits = NDArray[np.float32]
"""(N, 256) zeros and ones: sums and products of such are exact, whatever the order."""
Integers = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Vocabulary:
    """A tree of descriptors, breadth first; node 0 is the root, and children of a node follow each other."""

    branches: int
    levels: int
    parents: Integers
    """(N,) of every node; -1 of the root."""
    descriptors: Bytes
    """(N, 32); zeros of the root."""
    weights: NDArray[np.float64]
    """(N,) of the words; 0 of other nodes."""

    @cached_property
    def children(self) -> list[slice]:
        """Children of every node; none of a leaf."""
        nodes = np.arange(len(self.parents))
        ends = (np.searchsorted(self.parents, nodes, side).tolist() for side in ("left", "right"))
        return [slice(first, last) for first, last in zip(*ends, strict=True)]

    @property
    def leaves(self) -> NDArray[np.bool_]:
        """(N,) which nodes are words."""
        return np.array([branch.start == branch.stop for branch in self.children])

    def words(self, descriptors: Bytes) -> Integers:
        """(M,) leaf of each descriptor (M, 32): down the tree, always to the nearest child."""
        found = np.zeros(len(descriptors), np.int64)
        waiting = deque([(0, np.arange(len(descriptors)))])
        while waiting:
            node, members = waiting.popleft()
            branch = self.children[node]
            if branch.start == branch.stop:
                found[members] = node
            elif len(members):
                nearest = _distances(_bits(descriptors[members]), _bits(self.descriptors[branch])).argmin(axis=1)
                waiting += [(branch.start + i, members[nearest == i]) for i in range(branch.stop - branch.start)]
        return found

    def text(self) -> str:
        """The vocabulary as DBoW2's `loadFromTextFile` reads it; no line end at the end, which it takes for a node."""
        lines = [f"{self.branches} {self.levels} {_L1_NORM} {_TF_IDF}"]
        rows = zip(self.parents.tolist(), self.leaves.tolist(), self.descriptors, self.weights.tolist(), strict=True)
        for parent, leaf, descriptor, weight in list(rows)[1:]:
            lines.append(f"{parent} {int(leaf)} {' '.join(map(str, descriptor.tolist()))} {weight:.6g}")
        return "\n".join(lines)


def train(pictures: Sequence[Bytes], branches: int, levels: int, seed: int) -> Vocabulary:
    """A vocabulary of the descriptors of some pictures."""
    whole = np.concatenate(pictures)
    parents, descriptors = _tree(whole, branches, levels, np.random.default_rng(seed))
    bare = Vocabulary(branches, levels, parents, descriptors, np.zeros(len(parents)))
    ends = np.cumsum([len(picture) for picture in pictures])[:-1]
    weights = _inverse_document_frequencies(np.split(bare.words(whole), ends), len(parents))
    return Vocabulary(branches, levels, parents, descriptors, weights)


def _tree(whole: Bytes, branches: int, levels: int, random: np.random.Generator) -> tuple[Integers, Bytes]:
    """Parent and descriptor of every node."""
    parents, descriptors = [-1], [np.zeros(whole.shape[1], np.uint8)]
    waiting = deque([(0, 0, np.arange(len(whole)))])
    while waiting:
        node, level, members = waiting.popleft()
        if level == levels or len(members) < 2:
            continue
        centres, nearest = _split(_bits(whole[members]), branches, random)
        groups = [members[nearest == group] for group in range(len(centres))]
        if sum(len(group) > 0 for group in groups) < 2:
            continue
        for centre, group in zip(np.packbits(centres.astype(np.uint8), axis=1), groups, strict=True):
            if len(group):
                waiting.append((len(parents), level + 1, group))
                parents.append(node)
                descriptors.append(centre)
    return np.array(parents, np.int64), np.array(descriptors, np.uint8)


def _split(bits: Bits, branches: int, random: np.random.Generator) -> tuple[Bits, Integers]:
    """Majorities (K, 256) of at most `branches` groups, and which is nearest to each descriptor."""
    centres = _seeds(bits, branches, random)
    nearest = _distances(bits, centres).argmin(axis=1)
    for _ in range(_MOST_ROUNDS):
        centres = _majorities(bits, nearest, centres)
        before, nearest = nearest, _distances(bits, centres).argmin(axis=1)
        if (before == nearest).all():
            break
    return centres, nearest


def _seeds(bits: Bits, branches: int, random: np.random.Generator) -> Bits:
    """Different descriptors, drawn with a chance that grows with the distance to those drawn before."""
    chosen = [int(random.integers(len(bits)))]
    far = _distances(bits, bits[chosen])[:, 0]
    while len(chosen) < branches and far.any():
        reach = np.cumsum(far.astype(np.int64))
        chosen.append(int(np.searchsorted(reach, random.integers(reach[-1]), side="right")))
        far = np.minimum(far, _distances(bits, bits[chosen[-1:]])[:, 0])
    return bits[chosen]


def _majorities(bits: Bits, nearest: Integers, centres: Bits) -> Bits:
    """What at least half of each group have, bit by bit; an empty group keeps its centre."""
    member = np.eye(len(centres), dtype=np.float32)[nearest].T  # (K, N)
    sizes = member.sum(axis=1, keepdims=True)
    return np.where(sizes > 0, 2 * (member @ bits) >= sizes, centres).astype(np.float32)


def _distances(bits: Bits, centres: Bits) -> NDArray[np.float32]:
    """(N, K) bits that differ."""
    found: NDArray[np.float32] = bits.sum(axis=1)[:, None] + centres.sum(axis=1) - 2 * (bits @ centres.T)
    return found


def _bits(descriptors: Bytes) -> Bits:
    return np.unpackbits(descriptors, axis=1).astype(np.float32)


def _inverse_document_frequencies(words: Sequence[Integers], nodes: int) -> NDArray[np.float64]:
    """(nodes,) ln(pictures / pictures with the word); 0 where no picture has it."""
    shown = np.zeros(nodes, np.int64)
    for picture in words:
        shown[np.unique(picture)] += 1
    return np.where(shown > 0, np.log(len(words) / np.maximum(shown, 1)), 0.0)


def described(pictures: Sequence[bytes]) -> Iterator[Bytes]:
    """ORB descriptors of encoded pictures; pictures without any are left out."""
    cv2.setNumThreads(1)
    orb: Any = cv2.ORB_create(FEATURES, SCALE, OCTAVES, fastThreshold=LEAST_CONTRAST)  # type: ignore[attr-defined]
    for picture in pictures:
        _, found = orb.detectAndCompute(cv2.cvtColor(decode_colour(picture), cv2.COLOR_RGB2GRAY), None)
        if found is not None:
            yield found


def chosen_pictures(run: Path, logs: Sequence[str] | None, most: int) -> list[bytes]:
    """Encoded pictures, at most so many, evenly over all keyframes of some logs of a run; None means all logs.

    Raises:
        SemslamError: the run lacks a log, or has no keyframes.
    """
    files = {log: tables.get(FRAMES.name, ()) for log, tables in run_tables(run, [FRAMES], logs).items()}
    lacking = [log for log in (logs or files) if not files.get(log)]
    if lacking or not files:
        what = f"keyframes of log `{lacking[0]}`" if lacking else "keyframes"
        raise SemslamError(f"Run `{run}` has no {what}", hint=f"`semslam run DATASET/logs --out {run}` makes them")
    tables = [TableFiles(FRAMES, files[log]) for log in sorted(files)]
    whole = sum(table.rows for table in tables)
    wanted = set(np.linspace(0, whole, min(most, whole), endpoint=False).astype(np.int64).tolist())
    pictures = (row for table in tables for batch in table.batches(["colour"]) for row in batch["colour"])
    return [picture for number, picture in enumerate(pictures) if number in wanted]


def main() -> None:
    """Pictures, descriptors, tree, file."""
    args = _arguments()
    pictures = list(described(chosen_pictures(args.run, args.logs, max(1, args.descriptors // FEATURES))))
    if len(pictures) < 2:
        raise SemslamError(f"`{args.run}` has too few pictures for a vocabulary", hint="name more logs")
    vocabulary = train(pictures, args.branches, args.levels, args.seed)
    args.out.write_text(vocabulary.text(), encoding="ascii")
    descriptors, words = sum(map(len, pictures)), int(vocabulary.leaves.sum())
    print(f"{args.out}: {words} words of {descriptors} descriptors in {len(pictures)} pictures", file=sys.stderr)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, metavar="RUN", help="output folder of `semslam run`")
    parser.add_argument("out", type=Path, metavar="OUT.txt")
    parser.add_argument("--logs", nargs="+", metavar="NAME", help="logs to learn from; all without this")
    parser.add_argument("--branches", type=_between(2, 20), default=10, help="most children of a node")
    parser.add_argument("--levels", type=_between(1, 10), default=5, help="below the root; ORB-SLAM3 matches 4 above")
    parser.add_argument("--seed", type=_between(0, 2**63 - 1), default=1)
    parser.add_argument("--descriptors", type=_between(1, 10**8), default=300_000, help="at most, in whole pictures")
    return parser.parse_args()


def _between(least: int, most: int) -> Callable[[str], int]:
    """Whole numbers that DBoW2 and the generator take."""

    def number(text: str) -> int:
        if not least <= (value := int(text)) <= most:
            raise argparse.ArgumentTypeError(f"{value} is not between {least} and {most}")
        return value

    return number


if __name__ == "__main__":
    try:
        main()
    except SemslamError as error:
        sys.exit(f"error: {error.text()}")
