"""How long a recorded topology takes: a trace of a million contacts of 250 agents, from the file to the prediction.

10,000 graphs of 100 random links, each for a second, 100,000 steps; one thread of linear algebra. Every row is a
process of its own: time and CPU time of the whole process, and its peak of memory. The first one reads the same file
with csv.reader alone; the last one is ``msg-analysis predict``. Prints Markdown; takes two minutes.
"""

from __future__ import annotations

import json
import os
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from msg_analysis.common.resources import SINGLE_THREAD

AGENTS, SECONDS, CONTACTS = 250, 10_000, 100
EXPERIMENT = "name: trace\nswitching: {trace: contacts.csv, hold: 1.0, undirected: true}\nrun: {dt: 0.1}\n"
READ = "import csv; print(sum(1 for _ in csv.reader(open('contacts.csv', newline=''))))"
LOAD = "from msg_analysis import Experiment; print(len(Experiment.load('trace.yaml').graph_list))"
PREDICT = "from msg_analysis.cli.main import main; main(['predict', 'trace.yaml', '--json'])"


def measured(code: str, folder: Path) -> tuple[float, float, float, str]:
    """Time, CPU time [s], memory [MB] and output of a Python process."""
    begin = time.monotonic()
    process = subprocess.Popen(
        [sys.executable, "-c", code], cwd=folder, stdout=subprocess.PIPE, text=True, env=os.environ | SINGLE_THREAD
    )
    assert process.stdout is not None
    output = process.stdout.read()
    _, status, used = os.wait4(process.pid, 0)
    assert status == 0, output
    return time.monotonic() - begin, used.ru_utime + used.ru_stime, used.ru_maxrss / 1000, output


def main() -> None:
    """Make the trace and measure."""
    rng = random.Random(1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "trace.yaml").write_text(EXPERIMENT)
        with (folder / "contacts.csv").open("w") as file:
            file.write("time,source,target\n")
            for now in range(SECONDS):
                for _ in range(CONTACTS):
                    source, target = rng.sample(range(1, AGENTS + 1), 2)
                    file.write(f"{now},{source},{target}\n")
        print("| | time [s] | CPU time [s] | memory [MB] |\n|---|---:|---:|---:|")
        for what, code in (("csv.reader alone", READ), ("the experiment", LOAD), ("msg-analysis predict", PREDICT)):
            wall, cpu, memory, output = measured(code, folder)
            print(f"| {what} | {wall:.1f} | {cpu:.1f} | {memory:.0f} |", flush=True)
        print(f"\nMean system error {json.loads(output)['emulated']['system_error']:.6g}")


if __name__ == "__main__":
    main()
