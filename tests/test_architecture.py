"""The rooms of the house: imports run downwards only, and planning costs nothing."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import semslam

ROOT = Path(semslam.__file__).parent

BELOW: dict[str, set[str]] = {
    "errors": set(),
    "labels": set(),
    "processes": set(),
    "metrics": {"errors", "labels", "geometry"},
    "map_metrics": {"errors", "labels"},
    "tables": {"errors", "labels"},
    "geometry": {"errors", "labels"},
    "logs": {"errors", "labels", "geometry", "tables"},
    "models": {"errors", "labels", "logs", "geometry", "tables"},
    "slam": {"errors", "labels", "metrics", "models", "logs", "geometry", "tables"},
    "stages": {"errors", "labels", "metrics", "slam", "models", "logs", "geometry", "tables"},
    "sim": {"errors", "labels", "processes", "logs", "geometry", "tables"},
    "pipeline": {"errors", "labels", "processes", "metrics", "stages", "slam", "models", "logs", "geometry", "tables"},
    "bench": {
        "errors", "labels", "processes", "metrics", "map_metrics",
        "pipeline", "stages", "slam", "models", "logs", "geometry", "tables",
    },
}  # fmt: skip
"""What each room may import besides itself."""

PLAIN_DATA = ("semslam.stages.settings", "semslam.stages.contract")
"""Configuration and the contract of a stage: standard library only, below everything that is configured or run."""

STAGE_FILES = ("ingest", "extract", "localize", "export")


def modules() -> list[Path]:
    return sorted(path for path in ROOT.rglob("*.py") if path != ROOT / "__init__.py")


def imported(path: Path) -> set[str]:
    """Every semslam module a file imports, at the top or inside a function."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} imports relatively"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return {name for name in names if name.startswith("semslam.")}


def room(path: Path) -> str:
    return path.relative_to(ROOT).parts[0].removesuffix(".py")


@pytest.mark.parametrize("path", modules(), ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_run_downwards(path: Path) -> None:
    """A room imports only itself and rooms below it; only the command line may reach the simulator and the benches."""
    here = room(path)
    allowed = BELOW[here] | {here, "__version__"}
    if path == ROOT / "pipeline" / "cli.py":
        allowed = allowed | {"sim", "bench"}
    reached = {name for name in imported(path) if not name.startswith(PLAIN_DATA)}
    above = {name for name in reached if name.split(".")[1] not in allowed}
    assert not above, f"{path.relative_to(ROOT)} reaches up to {sorted(above)}"


@pytest.mark.parametrize("name", STAGE_FILES)
def test_a_stage_never_imports_a_stage(name: str) -> None:
    """Stages meet in tables only."""
    others = {f"semslam.stages.{other}" for other in STAGE_FILES if other != name}
    found = {i for i in imported(ROOT / "stages" / f"{name}.py") if any(i.startswith(other) for other in others)}
    assert not found


def test_torch_only_where_networks_are_made() -> None:
    """Run time needs no torch."""
    for path in modules():
        if path.is_relative_to(ROOT / "models" / "nets") or path.is_relative_to(ROOT / "models" / "training"):
            continue
        tree = ast.parse(path.read_text())
        named = {a.name for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names}
        named |= {n.module or "" for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)}
        assert not {name for name in named if name.split(".")[0] == "torch"}, path


def test_no_circles_between_modules() -> None:
    """No module imports itself, however long the way round."""
    known = {".".join(("semslam", *p.relative_to(ROOT).with_suffix("").parts)): p for p in modules()}
    known = {name.removesuffix(".__init__"): path for name, path in known.items()}
    edges = {
        name: {target for i in imported(path) for target in (i, i.rpartition(".")[0]) if target in known} - {name}
        for name, path in known.items()
    }
    done: set[str] = set()

    def visit(name: str, way: tuple[str, ...]) -> None:
        assert name not in way, " -> ".join((*way, name))
        if name not in done:
            for target in sorted(edges[name]):
                visit(target, (*way, name))
            done.add(name)

    for name in sorted(edges):
        visit(name, ())


def test_links_at_the_root_point_into_the_package() -> None:
    """`pipeline`, `stages` and `models` at the root are for people; as links or as the text files git makes of them."""
    top = ROOT.parent
    for name in ("pipeline", "stages", "models"):
        link = top / name
        if not (link.is_symlink() or link.is_file()):
            pytest.skip("semslam is installed without its repository")
        target = link.readlink() if link.is_symlink() else Path(link.read_text().strip())
        assert target == Path("semslam") / name
