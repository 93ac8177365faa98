# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The first commands of a user with real processes: the tutorial, examples, the demo, a new experiment."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
from pages import ROOT, blocks, console, experiments, missing

from msg_analysis.bags.reading import read_record

DOCS = ROOT / "docs"


def started(command: str, place: Path) -> subprocess.Popen[str]:
    """Typed in a wide terminal, with the commands on the path; one of ours that needs no shell is started without."""
    programs = Path(sys.executable).parent
    environment = os.environ | {"COLUMNS": "100", "NO_COLOR": "1"}
    if found := re.fullmatch(r"(msg-(?:agents|analysis)) ([\w./ -]+?)(?: > ([\w.]+))?", command):
        words = [programs / found[1], *found[2].split()]
    else:
        words = ["bash", "-e", "-c", command]
        environment["PATH"] = f"{programs}{os.pathsep}{os.environ['PATH']}"
    with (place / found[3]).open("w") if found and found[3] else nullcontext(subprocess.PIPE) as stdout:
        return subprocess.Popen(words, cwd=place, env=environment, stdout=stdout, stderr=subprocess.PIPE, text=True)


def ended(process: subprocess.Popen[str], code: int = 0) -> str:
    """What it printed."""
    stdout, stderr = process.communicate(timeout=100)
    assert process.returncode == code, stderr
    return stdout


def script(text: str, place: Path) -> None:
    """Line by line; those that end with "&" go on until "wait"."""
    subprocess.run(["bash", "-n", "-c", text], check=True)
    meanwhile: list[subprocess.Popen[str]] = []
    for line in filter(None, text.splitlines()):
        if line.endswith(" &"):
            meanwhile.append(started(line.removesuffix(" &"), place))
        elif line == "wait":
            while meanwhile:
                ended(meanwhile.pop(0))
        else:
            ended(started(line, place))
    assert meanwhile == []


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
            script(by_hand, network.directory)
        printed = ended(started(shown.command, network.directory), 1 if "runs/loud" in shown.command else 0)
        assert missing(shown.lines, printed) == []


@pytest.mark.parametrize("name", ["discrete", "tracking"])
def test_example(name: str, network) -> None:
    (shown,) = [shown for shown in console(DOCS / "examples.md") if shown.command == f"msg-agents run {name}"]
    printed = ended(started(f"{shown.command} --write-report never", network.directory))
    assert missing(shown.lines, printed) == []


SHORT = ("--duration", "2", "--processes", "1", "--no-analyse", "--json", "--out")


def test_demo(network: Any) -> None:
    """An example that needs no file."""
    result = network.completed(network.start("demo", *SHORT, network.directory / "runs"))
    assert read_record(Path(result["bag"])).experiment.name == "line_ring"


def test_new_experiment(network: Any) -> None:
    file = network.directory / "lab.yaml"
    new = network.start("new", file, "--agents", "4", "--graph", "star", "--loss", "0.2")
    assert (*new.communicate(timeout=60), new.returncode)[1:] == ("", 0)
    result = network.completed(network.start("run", file, *SHORT, network.directory / "runs"))
    assert read_record(Path(result["bag"])).experiment.agents == 4
