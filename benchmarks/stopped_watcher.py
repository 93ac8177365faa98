"""How long a network goes on, and then stands, when a reliable reader of it is stopped.

Starts a network, `msg-agents live --reliable`, and a second `msg-agents live`, for which nobody waits and which says
once a second how far the network is; then stops the first (SIGSTOP, as Ctrl-Z does) and watches the second. About a
minute.
"""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import time
from pathlib import Path

from msg_agents.discovery.rtps import free_domain

PROGRAM = str(Path(sys.executable).with_name("msg-agents"))
EXPERIMENT = str(Path(__file__).parents[1] / "analysis/msg_analysis/experiment/bundled/line_ring.yaml")
BEFORE = 3000  # steps made before the stop


def main() -> None:
    """Print what happened."""
    with free_domain() as domain:
        there = ("--domain", str(domain))
        held = subprocess.Popen([PROGRAM, "live", "--reliable", *there], stdout=subprocess.DEVNULL)
        seen = subprocess.Popen([PROGRAM, "live", *there], stdout=subprocess.PIPE, text=True)
        command = [PROGRAM, "run", EXPERIMENT, "--no-record", "--duration", "10000", *there]
        run = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        try:
            stopped: int | None = None  # step at which
            stands: tuple[int, float] | None = None  # at which step, since when
            before, came = -1, time.monotonic()
            assert seen.stdout
            for line in seen.stdout:
                found = re.match(r"step (\d+) of", line)
                if not found:
                    continue
                step, now = int(found[1]), time.monotonic()
                if stopped is None and step > BEFORE:
                    held.send_signal(signal.SIGSTOP)
                    stopped = step
                elif stopped is not None and stands is None and step == before:
                    stands = step, came
                    print(f"the network makes {step - stopped} steps more, and stands", flush=True)
                elif stands is not None and step > stands[0]:
                    print(f"goes on after {now - stands[1]:.0f} s, to within the second between two looks", flush=True)
                    break
                if step > before:
                    before, came = step, now
        finally:
            held.kill()
            for process in (seen, run):
                process.send_signal(signal.SIGINT)
                process.wait()


if __name__ == "__main__":
    main()
