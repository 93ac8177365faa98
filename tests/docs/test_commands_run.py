"""Every command of the pages is run: here, shortened, or by a test in a list; another list says why the rest is not.

Whole lines of terminals, shell and indented blocks count, and commands in the text of "Which page do I need". Terminals
whose output test_pages.py compares are left to it.
"""

import functools
import re
import shlex
import shutil
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest
from pages import EXPERIMENTS, FENCED, INDENTED, PAGES, PRINTING, ROOT, blocks, console, experiments, missing
from programs import PROGRAMS, run
from robots import write_robots

OTHERS = "cd|colcon|dask|docker (?:build|compose|run)|export|for|make|pip|python3?|rosdep|ros2|scp|sed|source|sudo|wait"
COMMAND = re.compile(rf"(?:\$ )?((?:[A-Z_]+=\S+ )*(?:\.venv/bin/)?(?:msg-agents|msg-analysis|{OTHERS})\b.*)")
SYNOPSIS = re.compile(r" \[|\.\.\.| (?:EXPERIMENT|SWEEP|RESULT|RUN_RECORD|A B)\b")  # test_pages.py knows their options

TESTED = {  # and where
    r"msg-agents demo": "tests/integration/test_docs.py",
    r"msg-agents run lab\.yaml": "tests/integration/test_docs.py",
    r"msg-agents run line_ring\.yaml$|msg-agents run line_ring\.yaml --json": "tests/integration/test_docs.py",
    r"msg-agents run line_ring --no-record": "tests/integration/test_bag.py",
    r"msg-agents run line_ring(\.yaml)? --web": "tests/integration/test_view.py",
    r"msg-agents run line_ring\.yaml --domain 42$": "tests/integration/test_live.py",
    r"msg-agents run line_ring --domain 42 --await my_node": "tests/integration/test_cyclone.py",
    r"msg-agents run line_ring_realtime": "tests/integration/test_realtime.py",
    r"msg-agents run median\.yaml": "tests/integration/test_protocols.py",
    r"msg-agents run team\.yaml": "tests/integration/test_external_agent.py",
    r"msg-agents run \w+ --channel channel\.yaml": "tests/integration/test_channel.py",
    r"msg-agents (live|play)\b": "tests/integration/test_live.py",
    r"msg-agents markers": "tests/integration/test_live.py",
    r"msg-agents (recorder|agent|switcher)\b": "tests/integration/test_single_nodes.py",
    r"msg-agents host": "tests/integration/test_hosts.py",
    r"msg-agents check$": "tests/integration/test_docs.py",
    r"(ROS_DISCOVERY_SERVER=\S+ )?msg-agents doctor$": "tests/integration/test_doctor.py",
    r"msg-analysis sweep (rates|rates_and_loss)\.yaml": "tests/analysis/cli/test_sweep.py",
    r"msg-analysis figures 3": "tests/analysis/paper/test_paper.py",
    r"python docs/cyclone_dds/cyclone_agent\.py": "tests/integration/test_cyclone.py",
    r"python docs/external_agent/(my_agent|robot|dds_robot)\.py": "tests/integration/test_external_agent.py",
    r"\.venv/bin/python benchmarks/errata\.py": "tests/analysis/paper/test_errata.py",
    r"sed 's/\"process\"": "tests/integration/test_docs.py",
    r"wait": "tests/integration/test_docs.py",
    r"pip install dist/": "requirements/try_wheels.py",
}
NOT_RUN = {  # and why
    r"ros2 |\S+=\S+ .*ros2 |rosdep |source install/": "needs an installed ROS 2, which the wheels do not contain",
    r"docker ": "needs a container engine: make container runs them",
    r"(make|sudo|pip|colcon|python3 -m (venv|colcon))\b": "sets up, builds, or tests everything",
    r"(\.venv/bin/)?python (-m pytest|benchmarks/)": "measures for minutes, or is a test; options: test_pages.py",
    r"(cd|export) ": "changes the shell only",
    r"scp |dask ": "needs several machines",
    r"for ": "a loop of the shell over a command of test_compare.py",
}


def lines(page: Path) -> Iterator[str]:
    """Lines of a page that may be commands, those that go on in the next line as one."""
    text = page.read_text(encoding="utf-8")
    if page not in PRINTING:
        yield from (shown.command for shown in console(page))
    shell = [*blocks(page, "sh", "bash"), *INDENTED.findall(FENCED.sub("", text))]
    for line in re.sub(r"\\\n\s*", "", "\n".join(shell)).splitlines():
        yield from line.strip().split("; ") if not line.strip().startswith("for ") else [line.strip()]
    if page.stem == "which_page":
        yield from re.findall(r"(?<!\[)`([^`\n]+)`", text)


@functools.cache
def commands() -> list[str]:
    found = []
    for page in PAGES:
        for line in lines(page):
            if command := COMMAND.fullmatch(line.partition(" #")[0].rstrip(" &")):
                found.append(command[1])
    return [command for command in dict.fromkeys(found) if not SYNOPSIS.search(command)]


def matched(patterns: dict[str, str], command: str) -> str | None:
    return next((pattern for pattern in patterns if re.match(pattern, command)), None)


BAGS = {  # by the seeds of the runs in them
    "1": ["runs/line_ring_1", "runs/line_ring_20261120_093900", "BAG", "bag", "mine", "try", "line_ring_twin"],
    "13": ["runs/line_ring_2", "runs/line_ring_20261120_150900", "BAG2"],
    "3": ["runs/line_ring_3"],
}


def essence(command: str) -> str:
    """The same for commands that differ only in names of one bag or of a report: one of them is run."""
    known = {name: seed for seed, names in BAGS.items() for name in names}
    return " ".join(known.get(word, re.sub(r".+\.html$", "report.html", word)) for word in command.split())


OURS_HERE = [command for command in commands() if not matched(TESTED, command) and not matched(NOT_RUN, command)]
HERE = list({essence(command): command for command in reversed(OURS_HERE)}.values())[::-1]


def test_lists() -> None:
    """No entry without a command, and no test that does not exist; what is left is ours, and run below."""
    known = TESTED | NOT_RUN
    assert [pattern for pattern in known if not any(re.match(pattern, each) for each in commands())] == []
    assert [file for file in TESTED.values() if not (ROOT / file).exists()] == []
    assert {command.split()[0] for command in HERE} == set(PROGRAMS)
    assert len(HERE) > 30


DURATION = "20"
OF_ROBOTS = ("msg-analysis map robots", "msg-analysis compare robots")
SHOWN = {  # what is printed is on the page
    shown.command: shown.lines
    for name in ("commands", "experiment", "own_robots")
    for shown in console(ROOT / f"docs/{name}.md")
    if shown.command.startswith(("msg-analysis diff ", "msg-analysis predict bad.yaml", *OF_ROBOTS))
}
BAD = """
name: bad
graphs: {line: {path: [1, 2, 3, 4, 5]}, ring: {cycle: [1, 2, 3, 4, 5]}}
switching: {generator: [[-0.6, 0.5], [0.5, -0.5]]}
noise: {proces: 1}
run: {dt: 0.6, duration: 400.3}
"""


@pytest.fixture(scope="module")
def twins(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Short bags, and the results of two of them."""
    place = tmp_path_factory.mktemp("twins")
    for seed in BAGS:
        bag = str(place / seed)
        for call in (
            ["simulate", "line_ring", "--duration", DURATION, "--seed", seed, "--out", bag],
            ["compare", bag, "--json"],
        ):
            result = run("msg-analysis", *call)
            assert result.exit_code == 0, result.output
        (place / f"leader_{seed}.json").write_text(result.stdout)
    write_robots(place / "robots")
    (place / "law.yaml").write_text(experiments(ROOT / "docs/own_robots.md")["robots"])
    (place / "map.yaml").write_text(run("msg-analysis", "map", str(place / "robots")).stdout)
    return place


@pytest.mark.parametrize("command", HERE)
def test_command_runs(command: str, twins: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a directory with what the commands before it on its page make, bags and files, but not with what it makes."""
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.chdir(tmp_path)
    shutil.copytree(EXPERIMENTS, tmp_path, dirs_exist_ok=True)
    (tmp_path / "star_ring.yaml").write_text(experiments(ROOT / "docs/tutorial.md")["star_ring"])
    (tmp_path / "bad.yaml").write_text(BAD)
    program, *arguments = shlex.split(re.sub(r"--duration \d+", f"--duration {DURATION}", command.partition(" > ")[0]))
    if arguments[0] == "run":
        arguments += ["--write-report", "never"]
        if "--duration" not in arguments:
            arguments += ["--duration", DURATION]
    made = [after for word, after in pairwise(arguments) if word == "--out"]
    if arguments[0] != "new":
        shutil.copy("line_ring.yaml", "lab.yaml")
    for seed, names in BAGS.items():
        for bag in names:
            if bag not in made:
                shutil.copytree(twins / seed, bag)
    for file in (*twins.glob("*.json"), *twins.glob("*.yaml")):
        shutil.copy(file, tmp_path)
    if command.startswith(OF_ROBOTS):
        shutil.copytree(twins / "robots", "robots")
    arguments = [match for word in arguments for match in ([*map(str, Path().glob(word))] if "*" in word else [word])]
    result = run(program, *arguments)
    assert result.exit_code == (2 if "bad.yaml" in command else 0), result.output
    assert result.output
    assert missing(SHOWN.get(command, []), result.output) == []
