"""The pages with real processes: the tutorial from its first line to its last, and examples."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from pages import ROOT, blocks, console, experiments, missing

DOCS = ROOT / "docs"


def shell(script: str, place: Path) -> subprocess.CompletedProcess[str]:
    """Typed in a wide terminal, with the commands on the path; one of ours that needs no shell is run without."""
    programs = Path(sys.executable).parent
    environment = os.environ | {"COLUMNS": "100", "NO_COLOR": "1"}
    if re.fullmatch(r"msg-(agents|analysis) [\w./ -]+", script):
        name, *arguments = script.split()
        command = [programs / name, *arguments]
    else:
        command = ["bash", "-e", "-c", script]
        environment["PATH"] = f"{programs}{os.pathsep}{os.environ['PATH']}"
    return subprocess.run(command, cwd=place, env=environment, capture_output=True, text=True, timeout=100)


@pytest.mark.timeout(300)
def test_tutorial(network, domain: int) -> None:
    """Every command of the page that starts a network or looks at one, in order; tests/docs has seen the others.

    The first block of a shell sets up what is set up here.
    """
    page = DOCS / "tutorial.md"
    ((name, text),) = experiments(page).items()
    (network.directory / f"{name}.yaml").write_text(text)
    by_hand = list(blocks(page, "sh"))[1]
    assert "loud.json" in by_hand
    for shown in console(page):
        if shown.command.startswith(("msg-analysis info", "msg-analysis predict")):
            continue
        if "runs/loud" in shown.command and not (network.directory / "runs/loud").exists():
            played = shell(by_hand, network.directory)
            assert played.returncode == 0, played.stderr
        result = shell(shown.command, network.directory)
        assert result.returncode == (1 if "runs/loud" in shown.command else 0), result.stderr
        assert missing(shown.lines, result.stdout) == []


@pytest.mark.parametrize("name", ["discrete", "tracking"])
def test_example(name: str, network) -> None:
    (shown,) = [shown for shown in console(DOCS / "examples.md") if shown.command == f"msg-agents run {name}"]
    result = shell(shown.command, network.directory)
    assert result.returncode == 0, result.stderr
    assert missing(shown.lines, result.stdout) == []
