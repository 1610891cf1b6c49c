"""Vocabularies for ORB-SLAM3: the format, the same bytes again, and words that are nearest to what they stand for."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.orb_vocabulary import Bytes, train

BRANCHES, LEVELS, PROTOTYPES, PICTURES = 4, 2, 16, 6


@pytest.fixture(scope="module")
def prototypes() -> Bytes:
    """Descriptors that differ in about half of their bits."""
    return np.random.default_rng(7).integers(0, 256, (PROTOTYPES, 32), np.uint8)


def pictures_of(prototypes: Bytes, changed: float = 0.02, seed: int = 8) -> list[Bytes]:
    """Pictures of all prototypes with a share of their bits changed; the first alone shows the last prototype."""
    random = np.random.default_rng(seed)
    shown = [prototypes if picture == 0 else prototypes[:-1] for picture in range(PICTURES)]
    return [one ^ np.packbits(random.random((len(one), 256)) < changed, axis=1) for one in shown]


def hamming(one: Bytes, other: Bytes) -> NDArray[np.int64]:
    """(N, M) bits that differ, counted by another way than the script's."""
    differing: NDArray[np.int64] = np.bitwise_count(one[:, None] ^ other[None]).sum(axis=2, dtype=np.int64)
    return differing


def parsed(text: str) -> tuple[list[int], list[list[str]]]:
    """Header and fields of every node, as DBoW2 splits them."""
    header, *lines = text.split("\n")
    return [int(value) for value in header.split()], [line.split() for line in lines]


def test_the_file_is_what_dbow2_reads(prototypes: Bytes) -> None:
    """Header, then a line a node whose number is its line; parents come first and leaves are those without children."""
    vocabulary = train(pictures_of(prototypes), BRANCHES, LEVELS, seed=1)
    header, rows = parsed(vocabulary.text())
    assert header == [BRANCHES, LEVELS, 0, 0]
    assert {len(row) for row in rows} == {1 + 1 + 32 + 1}, "every line is a node, the last one too"
    parents = [int(row[0]) for row in rows]
    assert all(parent < number for number, parent in enumerate(parents, start=1))
    assert [row[1] == "1" for row in rows] == [number not in parents for number in range(1, len(rows) + 1)]
    assert all(0 <= int(value) <= 255 for row in rows for value in row[2:34])
    assert parents.count(0) == BRANCHES
    assert max(parents.count(parent) for parent in parents) <= BRANCHES
    assert BRANCHES < len(rows) <= BRANCHES + BRANCHES**LEVELS


def test_the_same_bytes_again(prototypes: Bytes) -> None:
    """The seed decides, and nothing else does."""
    first, again, other = (train(pictures_of(prototypes), BRANCHES, LEVELS, seed).text() for seed in (1, 1, 2))
    assert first == again != other


def test_a_word_is_the_leaf_nearest_to_its_descriptors(prototypes: Bytes) -> None:
    """One level: the prototypes are the words, found again from copies with changed bits."""
    vocabulary = train(pictures_of(prototypes, changed=0.0), PROTOTYPES, 1, seed=1)
    assert sorted(vocabulary.descriptors[1:].tolist()) == sorted(prototypes.tolist())
    copies = pictures_of(prototypes)[0]
    words = vocabulary.words(copies)
    assert words.tolist() == (1 + hamming(copies, vocabulary.descriptors[1:]).argmin(axis=1)).tolist()
    assert vocabulary.descriptors[words].tolist() == prototypes.tolist()


def test_rare_words_weigh_more(prototypes: Bytes) -> None:
    """ln(pictures / pictures that show the word): nothing for what all show."""
    vocabulary = train(pictures_of(prototypes, changed=0.0), PROTOTYPES, 1, seed=1)
    weights = vocabulary.weights[vocabulary.words(prototypes)]
    np.testing.assert_allclose(weights, [0.0] * (PROTOTYPES - 1) + [math.log(PICTURES)])


def test_equal_descriptors_are_one_word() -> None:
    """What cannot be split ends the tree before its last level."""
    same = np.full((5, 32), 3, np.uint8)
    vocabulary = train([same, np.concatenate([same, same ^ 255])], 3, 4, seed=1)
    assert sorted(parsed(vocabulary.text())[1]) == [
        ["0", "1", *["252"] * 32, f"{math.log(2):.6g}"],
        ["0", "1", *["3"] * 32, "0"],
    ]
