"""What the live panel, and the page of --web, cost a run: the demo network with and without, in turn.

CPU is that of the whole command, comparison and report included, which are the same in all.
"""

from __future__ import annotations

import argparse
import json
import os
import pty
import resource
import statistics
import subprocess
import sys
import tempfile
import termios
import threading
from pathlib import Path

EXPERIMENT = Path(__file__).parents[1] / "analysis/msg_analysis/experiment/bundled/line_ring.yaml"
PROGRAM = Path(sys.executable).with_name("msg-agents")
KINDS = ("plain", "panel", "panel and page")


def _run(kind: str, duration: float, directory: str) -> tuple[float, float]:
    """Steps per second, and CPU seconds."""
    command = [str(PROGRAM), "run", str(EXPERIMENT), "--duration", str(duration), "--out", directory, "--json"]
    if kind == "panel and page":
        command += ["--web", "0"]
    master, slave = pty.openpty()
    termios.tcsetwinsize(slave, (24, 80))
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL if kind == "plain" else slave, text=True
    )
    os.close(slave)

    def drain() -> None:
        try:
            while os.read(master, 65536):
                pass
        except OSError:  # the terminal has no other end any more
            pass

    reader = threading.Thread(target=drain, daemon=True)
    reader.start()
    result = json.loads(process.communicate()[0])
    reader.join(timeout=5)
    os.close(master)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return result["rate"], cpu


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pairs", type=int, default=5)
    parser.add_argument("--duration", type=float, default=800.0, help="units of simulated time; 20 steps each")
    options = parser.parse_args()
    found: dict[str, list[tuple[float, float]]] = {kind: [] for kind in KINDS}
    with tempfile.TemporaryDirectory() as directory:
        for turn in range(options.pairs):
            for place in range(len(KINDS)):
                kind = KINDS[(turn + place) % len(KINDS)]
                found[kind].append(_run(kind, options.duration, directory))
    print("| | steps/s | median | CPU [s] | median |\n|---|---|---:|---|---:|")
    for kind, runs in found.items():
        rates, seconds = zip(*runs, strict=True)
        columns = [", ".join(f"{rate:.0f}" for rate in rates), f"{statistics.median(rates):.0f}"]
        columns += [", ".join(f"{second:.1f}" for second in seconds), f"{statistics.median(seconds):.1f}"]
        print(f"| {' | '.join([kind, *columns])} |")


if __name__ == "__main__":
    main()
