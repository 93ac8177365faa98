"""Runs of a calibration side by side; what is kept of each is in build/calibration, by the version of the code.

So an interrupted calibration goes on where it was.
"""

from __future__ import annotations

import hashlib
import json
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import msg_analysis
from msg_analysis.sweeps.workers import LocalWorkers, Lost

ROOT = Path(__file__).parents[1]
ROOMS = ("model", "theory", "twin", "inference")
BENCHMARKS = ("any_time.py", "calibration*.py")

Run = Callable[[tuple[str, int], Callable[[], bool]], dict[str, Any]]
"""Makes a run of a case, by number; the second argument says whether it is to stop."""


def version() -> str:
    """Of all code that a result depends on."""
    digest, source = hashlib.sha256(), Path(msg_analysis.__file__).parent
    files = [path for name in BENCHMARKS for path in sorted(Path(__file__).parent.glob(name))]
    for path in [*files, *(path for room in ROOMS for path in sorted((source / room).rglob("*.py")))]:
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def run_all(one_run: Run, runs: Mapping[str, int], name: str, processes: int) -> dict[str, list[dict[str, Any]]]:
    """Results of all runs of all cases, those that are in the store ``name`` already not made again."""
    store = ROOT / "build/calibration" / version() / f"{name}.jsonl"
    store.parent.mkdir(parents=True, exist_ok=True)
    done: dict[tuple[str, int], dict[str, Any]] = {}
    if store.is_file():
        for line in store.read_text(encoding="utf-8").splitlines():
            try:
                case, seed, kept = json.loads(line)
            except ValueError:  # the last line of a calibration that was killed
                continue
            done[case, seed] = kept
    jobs = [(case, seed) for case, count in runs.items() for seed in range(count) if (case, seed) not in done]
    jobs.sort(key=lambda job: job[1])  # all cases side by side, so that the time left can be told
    begin = time.monotonic()
    told = count = 0
    with LocalWorkers(processes) as pool, store.open("a") as file:
        for batch in pool.outcomes(one_run, jobs):
            for (case, seed), kept in batch:
                if isinstance(kept, Lost):
                    sys.exit(f"error: {case}, run {seed}: {kept.reason}")
                done[case, seed] = kept
                file.write(json.dumps([case, seed, kept]) + "\n")
            file.flush()
            count += len(batch)
            if count // 100 > told:
                told = count // 100
                left = (time.monotonic() - begin) / count * (len(jobs) - count) / 60
                print(f"{count} of {len(jobs)} runs, {left:.0f} minutes left", file=sys.stderr, flush=True)
    return {case: [done[case, seed] for seed in range(count)] for case, count in runs.items()}
