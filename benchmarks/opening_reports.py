"""How long a browser works until a report can be read: CPU time of the page's process, for 5 and for 100 agents.

    .venv/bin/python benchmarks/opening_reports.py [--rounds 5] [REPORT...]

Without reports, two are made: 8,000 steps, 16 replicas. CPU time, as other programs on the machine hardly change it.
"""

from __future__ import annotations

import argparse
import os
import shutil
import statistics
import tempfile
from pathlib import Path
from typing import Any

from playwright.sync_api import sync_playwright

from msg_analysis import Experiment, write_report

PROGRAMS = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
CHROMIUM = next(filter(None, map(shutil.which, PROGRAMS)), None)
ARGUMENTS = ("--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking")
TICK = os.sysconf("SC_CLK_TCK")


def make(agents: int, folder: Path) -> Path:
    """The report of a simulated run of the line and the ring."""
    numbers = list(range(1, agents + 1))
    document = {
        "name": "line_ring",
        "graphs": {"line": {"path": numbers}, "ring": {"cycle": numbers}},
        "switching": {"generator": [[-0.5, 0.5], [0.5, -0.5]]},
        "run": {"dt": 0.05, "duration": 400, "replicas": 16, "start": "zero"},
    }
    return write_report(Experiment.parse(document).simulate().compare(), folder / f"{agents}_agents.html")


def drawing() -> float:
    """CPU seconds so far of the processes that draw pages, of those that this program has started."""
    parents, used = {}, {}
    for process in Path("/proc").glob("[0-9]*"):
        try:
            fields = (process / "stat").read_text().rpartition(")")[2].split()
            parents[int(process.name)] = int(fields[1])
            if b"--type=renderer" in (process / "cmdline").read_bytes():
                used[int(process.name)] = (int(fields[11]) + int(fields[12])) / TICK
        except OSError:  # it has ended
            continue

    def ours(process: int) -> bool:
        return process == os.getpid() or (process in parents and ours(parents[process]))

    return sum(seconds for process, seconds in used.items() if ours(process))


def opened(driver: Any, report: Path) -> tuple[float, float]:
    """CPU and wall seconds [s] until what is in view has been drawn."""
    browser = driver.chromium.launch(executable_path=CHROMIUM, args=list(ARGUMENTS))
    before = drawing()
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    page.goto(report.as_uri())
    page.wait_for_selector("body[data-ready=yes]")
    used = drawing() - before
    wall = page.evaluate("performance.now()") / 1000
    browser.close()
    return used, wall


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("reports", type=Path, nargs="*")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as driver:
        reports = [path.absolute() for path in options.reports] or [make(agents, Path(folder)) for agents in (5, 100)]
        for report in reports:
            rounds = [opened(driver, report) for _ in range(options.rounds)]
            used, wall = ([round(value, 2) for value in column] for column in zip(*rounds, strict=True))
            print(
                f"{report.name}: {report.stat().st_size / 1e6:.2f} MB; CPU {used} s, median {statistics.median(used)}"
            )
            print(f"  wall {wall} s, median {statistics.median(wall)}")


if __name__ == "__main__":
    main()
