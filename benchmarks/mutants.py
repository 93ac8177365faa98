"""Change five core files in one small place at a time, and count the changes that their tests notice: ``make mutants``.

Each file is changed by mutmut in a copy of the repository in ``build/mutants``, tested with the fast tests of this
file. What no test notices is printed as a diff: read it, and add a test where it matters.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).parents[1]
PLACE = ROOT / "build/mutants"
MUTMUT = PLACE / "bin/mutmut"
TESTS = {
    "msg_agents/msg_agents/stepping/synchronizer.py": "tests/agents/stepping -k synchronizer",
    "analysis/msg_analysis/theory/moments.py": "tests/analysis/theory/test_moments.py",
    "analysis/msg_analysis/inference/verdict.py": "tests/analysis/inference/test_compare.py -k 'not calibration'",
    "analysis/msg_analysis/bags/salvage.py": "tests/analysis/bags -k 'salvage and not 500 and not 200'",
    "analysis/msg_analysis/messages/acceptance.py": "tests/analysis/wire tests/agents/stepping/test_state_receiver.py",
}
ENOUGH = 0.85  # of all changes


def mutate(file: str, seconds: float | None) -> tuple[dict[str, list[str]], str]:
    """The numbers of the changes by outcome, and those that no test noticed as diffs."""
    copy = PLACE / Path(file).stem
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(ROOT, copy, symlinks=True, ignore=shutil.ignore_patterns(".*", "build", "dist*", "runs", "site"))
    runner = f"{sys.executable} -m pytest -x -p no:cacheprovider {TESTS[file]}"
    environment = os.environ | {
        "PYTHONPATH": f"{copy / 'analysis'}:{copy / 'msg_agents'}",
        "PYTHONDONTWRITEBYTECODE": "1",
        "OPENBLAS_NUM_THREADS": "1",
    }

    def mutmut(*arguments: str, timeout: float | None = None) -> str:
        call = [MUTMUT, *arguments]
        return subprocess.run(
            call, cwd=copy, env=environment, stdout=subprocess.PIPE, text=True, timeout=timeout
        ).stdout

    with contextlib.suppress(subprocess.TimeoutExpired):
        said = mutmut(
            "run", "--paths-to-mutate", file, "--tests-dir", "tests", "--runner", runner, "--CI", "--no-progress",
            timeout=seconds,
        )  # fmt: skip
        print(said[-2000:], file=sys.stderr)
    outcomes = ("killed", "timeout", "suspicious", "survived")
    found = {outcome: mutmut("result-ids", outcome).split() for outcome in outcomes}
    return found, "\n".join(mutmut("show", number) for number in found["survived"])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="*", help="names of files without .py: by default all five")
    parser.add_argument("--seconds", type=float, help="time for each file: what is left then is not changed")
    given = parser.parse_args()
    files = [file for file in TESTS if not given.files or Path(file).stem in given.files]
    good = True
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for file, (found, survived) in zip(files, pool.map(mutate, files, [given.seconds] * len(files)), strict=True):
            count = sum(map(len, found.values()))
            noticed = 1 - len(found["survived"]) / max(count, 1)
            print(survived)
            print(f"{file}: {count} changes, {noticed:.0%} noticed:", {what: len(ids) for what, ids in found.items()})
            good &= noticed >= ENOUGH and count > 0
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
