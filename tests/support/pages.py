"""The pages of the documentation as text: their blocks of code, commands and what these print."""

import re
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import yaml

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
PRINTS = {"README", "index", "quickstart", "tutorial", "examples", "leaders", "recorded"}
PRINTING = [page for page in PAGES if page.stem in PRINTS]
"""Pages whose terminals are compared with what the commands print."""
EXPERIMENTS = ROOT / "analysis/msg_analysis/experiment/bundled"
FENCED = re.compile(r"^( *)```(\w*)\n(.*?)^\1```", re.MULTILINE | re.DOTALL)
INDENTED = re.compile(r"(?:^\n)((?:^ {4,}\S.*\n|^\n(?= {4}))+)", re.MULTILINE)
STAMP = re.compile(r"_\d{8}_\d{6}")  # of the directory of a run
RULE = re.compile(r"[─\s]+")


class Shown(NamedTuple):
    """A command after a dollar, and the lines below it."""

    command: str
    lines: list[str]


def blocks(page: Path, *languages: str) -> Iterator[str]:
    """Fenced blocks of these languages, their indentation taken away."""
    for _, language, text in FENCED.findall(page.read_text(encoding="utf-8")):
        if language in languages:
            yield textwrap.dedent(text)


def python(page: Path) -> list[tuple[str, list[str]]]:
    """All Python blocks in their order, each with the lines of a block of text directly below, if there is one."""
    found = re.findall(
        r"^```python\n(.*?)^```\n(?:\n```text\n(.*?)^```)?", page.read_text("utf-8"), re.MULTILINE | re.DOTALL
    )
    return [(code, shown.splitlines()) for code, shown in found]


def files(page: Path) -> dict[str, str]:
    """Blocks below a line with the name of a file alone."""
    named = re.findall(r"^`([\w.]+)`\n\n```\w+\n(.*?)^```", page.read_text("utf-8"), re.MULTILINE | re.DOTALL)
    return dict(named)


def console(page: Path) -> list[Shown]:
    """All commands of the blocks of a terminal, in their order."""
    shown = []
    for block in blocks(page, "console"):
        for line in block.splitlines():
            if line.startswith("$ "):
                shown.append(Shown(line[2:], []))
            else:
                shown[-1].lines.append(line)
    return shown


def typed(page: Path) -> Iterator[str]:
    """Every line that a reader may type: of shell blocks, of terminals, and of indented blocks."""
    text = page.read_text(encoding="utf-8")
    for shown in console(page):
        yield shown.command
    rest = FENCED.sub("", text)
    for block in [*blocks(page, "sh", "bash"), *INDENTED.findall(rest)]:
        yield from re.sub(r"\\\n\s*", "", textwrap.dedent(block)).splitlines()
    yield from re.findall(r"`([^`\n]+)`", rest)


def experiments(page: Path) -> dict[str, str]:
    """The experiment files that a page shows whole, by name."""
    found = {}
    for block in blocks(page, "yaml"):
        document = yaml.safe_load(block)
        if isinstance(document, dict) and {"name", "graphs"} <= set(document):
            found[str(document["name"])] = block
    return found


def words(text: str) -> list[str]:
    """Lines without what depends on the day and on the width of the terminal."""
    lines = (" ".join(STAMP.sub("", line).split()) for line in text.splitlines())
    return [line for line in lines if line and not RULE.fullmatch(line)]


def missing(shown: list[str], printed: str) -> list[str]:
    """Lines of the page that were not printed, or not in this order; "..." stands for any lines."""
    left, absent = words(printed), []
    for line in words("\n".join(shown)):
        if line in left:
            left = left[left.index(line) + 1 :]
        elif line != "...":
            absent.append(line)
    return absent
