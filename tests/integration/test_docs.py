"""Pages word for word with real processes: every command and every Python block in order, with what they print."""

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from many_commands import ForkedCommand
from pages import EXPERIMENTS, ROOT, blocks, console, experiments, files, missing, python

from msg_analysis.bags.reading import read_record

DOCS = ROOT / "docs"
NEXT_BLOCK = "next block of the page"


def started(command: str, place: Path) -> Any:
    """Typed in a wide terminal, with the commands on the path; one of ours that needs no shell is forked."""
    environment = os.environ | {"COLUMNS": "100", "NO_COLOR": "1"}
    found = re.fullmatch(r"(msg-(?:agents|analysis)) ([\w./ -]+?)(?: > ([\w.]+))?", command)
    if found:
        stdout = place / found[3] if found[3] else None
        return ForkedCommand(found[1], found[2].split(), environment, folder=place, stdout=stdout)
    environment["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    pipes = dict.fromkeys(("stdout", "stderr"), subprocess.PIPE)
    return subprocess.Popen(["bash", "-e", "-c", command], cwd=place, env=environment, text=True, **pipes)


def ended(process: Any, code: int = 0) -> str:
    """What it printed."""
    stdout, stderr = process.communicate(timeout=100)
    assert process.returncode == code, stderr
    return stdout


def script(text: str, place: Path, patch: pytest.MonkeyPatch) -> None:
    """Line by line; those that end with "&" go on until "wait"."""
    subprocess.run(["bash", "-n", "-c", text], check=True)
    meanwhile: list[Any] = []
    for line in filter(None, text.splitlines()):
        word, *rest = line.split()
        if line.endswith(" &"):
            meanwhile.append(started(line.removesuffix(" &"), place))
        elif word == "export":
            for variable in rest:
                patch.setenv(*variable.split("="))
        elif word == "unset":
            for variable in rest:
                patch.delenv(variable)
        elif word == "wait":
            while meanwhile:
                ended(meanwhile.pop(0))
        else:
            ended(started(line, place))
    assert meanwhile == []


@pytest.mark.timeout(300)
@pytest.mark.parametrize("name", ["index", "tutorial", "protocols"])
def test_page(name: str, network, domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its files, then its commands; the shell block with a bag is run before the first command that reads this bag."""
    # A domain that the page chooses is replaced by the test's own, as other tests run at the same time.
    page, place = DOCS / f"{name}.md", network.directory
    written = files(page) | {f"{experiment}.yaml": text for experiment, text in experiments(page).items()}
    for file, text in written.items():
        (place / file).write_text(text)
    if "pyproject.toml" in written:  # not into this environment, as the page says
        pip = [sys.executable, "-m", "pip", "install", "-q", "--no-index", "--no-deps", "--no-build-isolation"]
        subprocess.run([*pip, "--target", place / "installed", place], check=True)
        monkeypatch.setenv("PYTHONPATH", str(place / "installed"), prepend=os.pathsep)
    shell = [block for block in blocks(page, "sh") if "--out runs/" in block]
    for shown in console(page):
        for block in [block for block in shell if shown.command.split()[-1] in block]:
            shell.remove(block)
            script(block.replace("ROS_DOMAIN_ID=42", f"ROS_DOMAIN_ID={domain}"), place, monkeypatch)
            assert os.environ.get("ROS_DOMAIN_ID") is None
            monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
        differs = int("disagrees" in "".join(shown.lines) or "differs from" in "".join(shown.lines))
        assert missing(shown.lines, ended(started(shown.command, place), differs)) == []
    assert shell == []


@pytest.mark.timeout(300)
@pytest.mark.parametrize("name", ["index", "protocols", "python"])
def test_python_blocks(name: str, network, domain: int) -> None:
    """One after the other, as in a notebook, in a folder with the examples; a block of text is what is printed."""
    page, place = DOCS / f"{name}.md", network.directory
    for file in EXPERIMENTS.glob("*.yaml"):
        (place / file.name).write_text(file.read_text())
    found = python(page)
    code = f"\nprint({NEXT_BLOCK!r})\n".join(block for block, _ in found)
    call = [sys.executable, "-P", "-W", "error::DeprecationWarning:__main__", "-c", code]
    process = subprocess.run(
        call, cwd=place, env=os.environ | {"MPLBACKEND": "agg"}, capture_output=True, text=True, timeout=280
    )
    assert process.returncode == 0, process.stderr
    printed = process.stdout.split(f"{NEXT_BLOCK}\n")
    assert [missing(shown, text) for (_, shown), text in zip(found, printed, strict=True)] == [[]] * len(found)
    made = re.findall(r'"(\w+\.(?:png|html))"\)', code)
    assert [file for file in made if (place / file).stat().st_size < 1000] == []


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
