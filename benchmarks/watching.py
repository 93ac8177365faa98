"""What it costs a network to be watched: speed and CPU time of a run alone, and with `msg-agents live` beside it.

CPU times hardly depend on what else the machine does; speeds do.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from msg_agents.discovery.rtps import free_domain

PROGRAM = Path(sys.executable).with_name("msg-agents")
EXPERIMENT = Path(__file__).parents[1] / "analysis/msg_analysis/experiment/bundled/line_ring.yaml"


def end(process: subprocess.Popen[str]) -> float:
    """CPU seconds of a process and its children, when it has ended."""
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    return usage.ru_utime + usage.ru_stime


def measure(experiment: Path, duration: float, live: list[str] | None, directory: Path) -> str:
    """One row."""
    watched, ran = directory / "live.json", directory / "run.json"
    with free_domain() as domain:
        watcher = None
        if live is not None:
            command = [str(PROGRAM), "live", "--json", "--domain", str(domain), *live]
            watcher = subprocess.Popen(command, stdout=watched.open("w"), stderr=subprocess.PIPE, text=True)
            assert watcher.stderr
            watcher.stderr.readline()  # that it waits for a network
        options = ["--no-record", "--json", "--domain", str(domain), "--duration", str(duration)]
        with ran.open("w") as stream:
            run = subprocess.Popen([str(PROGRAM), "run", str(experiment), *options], stdout=stream, text=True)
            cost = end(run)
        row = f"{json.loads(ran.read_text())['rate']:8.0f} {cost:14.1f}"
        if watcher is None:
            return row
        cost = end(watcher)
        seen = json.loads(watched.read_text())
        return f"{row} {cost:15.1f} {seen['first_step']:10d} {seen['steps']:8d} {seen['missing']:8d}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--experiment", type=Path, default=EXPERIMENT)
    parser.add_argument("--duration", type=float, default=600.0)
    parser.add_argument("--repeat", type=int, default=3)
    options = parser.parse_args()
    print("                 steps/s  CPU of run [s]  CPU of live [s]  first step    steps  missing")
    with tempfile.TemporaryDirectory() as directory:
        for _ in range(options.repeat):
            for name, live in (("alone", None), ("live", []), ("live --reliable", ["--reliable"])):
                row = measure(options.experiment, options.duration, live, Path(directory))
                print(f"{name:15s} {row}", flush=True)


if __name__ == "__main__":
    main()
