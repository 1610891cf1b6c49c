"""`results/<log>/<variant>/`: the files of the last stage under stable names, for people and other tools.

They are copies, not links, so that nobody's editor reaches into the cache. `cache/results.json` remembers the stamp of
every copy; a copy that is missing or was changed is made again by the next run.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from semslam.pipeline.cache import Entry, load_manifest
from semslam.pipeline.digest import FileStamp
from semslam.pipeline.files import copy_atomically, read_json, write_json
from semslam.pipeline.folder import OutputFolder


class Results:
    """Copies files of entries to where people look for them."""

    def __init__(self, folder: OutputFolder) -> None:
        self._folder = folder
        self._memory = folder.cache / "results.json"
        stored = read_json(self._memory)
        self._known: dict[str, dict[str, Any]] = stored if isinstance(stored, dict) else {}
        self._changed = False

    def publish(self, log: str, variant: str, entry: Entry) -> None:
        """Make the folder of a log and variant hold the files of the entry; others' files in it are left alone."""
        place = f"{log}/{variant}"
        known = self.known(log, variant)
        if known["key"] == entry.key and _untouched(f"{self._folder.results}/{place}", known["files"]):
            return
        target = self._folder.results / log / variant
        source = self._folder.stage(entry.stage) / entry.key
        names = result_names(load_manifest(source) or {})
        target.mkdir(parents=True, exist_ok=True)
        for gone in known["files"].keys() - names.keys():
            (target / gone).unlink(missing_ok=True)
        for name, stored in names.items():
            copy_atomically(source / stored["file"], target / name)
        stamps = {name: FileStamp.of(target / name).as_list() for name in names}
        self._known[place] = {"key": entry.key, "files": stamps}
        self._changed = True

    def known(self, log: str, variant: str) -> dict[str, Any]:
        """Key of the copied entry (empty for none) and the stamps of the copies."""
        return self._known.get(f"{log}/{variant}", {"key": "", "files": {}})

    def save(self) -> None:
        """Write the memory if it changed."""
        if self._changed:
            write_json(self._memory, self._known)
            self._changed = False


def published_key(folder: OutputFolder, log: str, variant: str) -> str:
    """Key of the entry whose files were copied last; empty if none were."""
    known = Results(folder).known(log, variant)
    return str(known["key"])


def result_names(manifest: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Files of an entry by the name they get; those of shards after the first carry the number of their shard."""
    tables = [file for table in manifest.get("tables", {}).values() for file in table["shards"]]
    names: dict[str, dict[str, Any]] = {}
    for file in [*tables, *manifest.get("files", [])]:
        path = Path(file["file"])
        number = path.parent.name.removeprefix("shard-")
        names[path.name if int(number) == 0 else f"{path.stem}-{number}{path.suffix}"] = file
    return names


def _untouched(folder: str, stamps: Mapping[str, list[int]]) -> bool:
    try:
        return all(FileStamp.of(f"{folder}/{name}").as_list() == stamp for name, stamp in stamps.items())
    except OSError:
        return False
