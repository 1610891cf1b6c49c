"""Fixtures of the tests that run stages; a plugin, so that several files can share them."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.fake_stages import CALLS
from tests.pipeline_helpers import World


@pytest.fixture
def world(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> World:
    """An empty world; in this process nothing waits for the disk, which is what takes the time."""
    made = World(tmp_path)
    monkeypatch.setenv(CALLS, str(made.calls_file))
    monkeypatch.setattr(os, "fsync", lambda _: None)
    return made
