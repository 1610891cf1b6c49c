"""What the documents show can be typed: commands, settings, links."""

from __future__ import annotations

import re
import shlex
import tomllib
from collections.abc import Iterator
from pathlib import Path

import click
import pytest

from semslam.pipeline.cli import cli
from semslam.pipeline.config import load_config
from semslam.stages.catalogue import STAGES

TOP = Path(__file__).parent.parent
PAGES = sorted([*TOP.glob("*.md"), *(TOP / "docs").rglob("*.md")])


def blocks(page: Path, language: str) -> list[str]:
    """Fenced blocks of a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL)


def typed(text: str) -> Iterator[str]:
    """The semslam commands of a block, one by one."""
    for line in text.splitlines():
        for part in line.split("&&"):
            if part.strip().startswith("semslam "):
                yield part.strip()


def examples() -> Iterator[tuple[str, str]]:
    """Every command line in documents and in help texts."""
    for page in PAGES:
        for block in blocks(page, "console"):
            for line in typed(block):
                yield page.name, line
        for inline in re.findall(r"`(semslam [^`]*)`", page.read_text()):
            if re.search(r"\w\.\w", inline) and not re.search(
                r"\.\.\.|[A-Z]{3,}", inline
            ):  # names and placeholders are none
                yield page.name, inline
    for name, command in commands(cli):
        found = list(typed(command.help or ""))
        yield f"{name} --help", found[0] if found else ""


def commands(group: click.Group, prefix: str = "semslam") -> Iterator[tuple[str, click.Command]]:
    """Every command, groups resolved."""
    for name, command in group.commands.items():
        if isinstance(command, click.Group):
            yield from commands(command, f"{prefix} {name}")
        else:
            yield f"{prefix} {name}", command


@pytest.mark.parametrize(("where", "line"), sorted(set(examples())), ids=lambda value: value[:60])
def test_example_can_be_typed(where: str, line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The command exists, takes these options, and these values have the right form."""
    assert line, f"{where} has no example"
    monkeypatch.chdir(tmp_path)
    words = shlex.split(line, comments=True)[1:]
    for word in words:
        if Path(word).suffix in (".mcap", ".onnx", ".txt", ".toml"):
            Path(word).touch()
    for folder in ("logs", "maps", "OUT"):
        Path(folder).mkdir()
    parse(cli, words)


def parse(command: click.Command, words: list[str]) -> None:
    """Let click parse a command line down to its last command, without running it."""
    context = click.Context(command, info_name="semslam")
    while isinstance(command, click.Group):
        flags = [word for word in words if word in ("--help", "--version")]
        if words[:1] == flags[:1]:
            return
        assert words, "a group needs a command"
        assert words[0] in command.commands, f"no command {words[0]}"
        command, words = command.commands[words[0]], words[1:]
        context = click.Context(command, info_name=command.name, parent=context)
    if "--help" not in words:
        command.parse_args(context, words)


def test_settings_in_documents_are_valid() -> None:
    """TOML blocks load as configuration."""
    seen = 0
    for page in PAGES:
        for block in blocks(page, "toml"):
            path = Path("unused.toml")
            values = {f"{s}.{k}": v for s, section in tomllib.loads(block).items() for k, v in section.items()}
            load_config(STAGES, None, (), values)
            assert not path.exists()
            seen += 1
    assert seen > 0


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    """Relative links and pictures point to files of the repository."""
    for target in re.findall(r"\]\((?!http)([^)#]+)", page.read_text()):
        assert (page.parent / target).exists(), f"{page.name}: {target}"


def test_readme_has_the_two_commands() -> None:
    """The first command installs and runs the demo, the one marked `tests` installs and tests."""
    first, second = blocks(TOP / "README.md", "console")[:2]
    assert "pip install ." in first
    assert "semslam demo" in first
    assert second.strip() == "pip install '.[test]' && pytest"
    assert "<!-- tests -->\n```console\n" + second in (TOP / "README.md").read_text()
