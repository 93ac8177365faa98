"""Change five core files in one small place at a time, and count the changes that their tests notice: ``make mutants``.

The changes are those of mutmut, but for texts. Each is tested in a forked process, in which the changed file is
imported instead of the one on the disk, with the fast tests of the file. What no test notices is printed.
"""

from __future__ import annotations

import argparse
import contextlib
import difflib
import importlib
import importlib.abc
import importlib.machinery
import json
import os
import random
import re
import shlex
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[1]
sys.path.append(str(ROOT / "build/mutants"))
TESTS = {
    "msg_agents/msg_agents/stepping/synchronizer.py": "tests/agents/stepping",
    "analysis/msg_analysis/theory/moments.py": "tests/analysis/theory/test_moments.py "
    "tests/analysis/theory/test_moments_precision.py "
    "tests/analysis/theory/test_prediction.py "
    "tests/analysis/theory/test_solvers.py -k 'not test_solvers or converge or dense'",
    "analysis/msg_analysis/inference/verdict.py": "tests/analysis/inference/test_verdict.py "
    "tests/analysis/inference/test_compare.py tests/analysis/inference/test_pool.py "
    "-k 'not calibration and not level_holds and not hardly and not common and not rounding and not many_agents'",
    "analysis/msg_analysis/bags/salvage.py": "tests/analysis/bags/test_salvage.py",
    "analysis/msg_analysis/messages/acceptance.py": "tests/analysis/messages/test_acceptance.py",
}
ENOUGH = 0.85  # of all changes
NOT_BEFORE = ("msg_", "_pytest", "__main__", "rclpy")  # not imported before the fork


class Changed(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Imports one module from this text."""

    def __init__(self, module: str, text: str) -> None:
        self.module, self.text = module, text

    def find_spec(self, name: str, *_: object) -> importlib.machinery.ModuleSpec | None:
        return importlib.machinery.ModuleSpec(name, self) if name == self.module else None

    def exec_module(self, module: ModuleType) -> None:
        exec(compile(self.text, self.module, "exec"), module.__dict__)


def changes(file: str) -> Iterator[str]:
    """The file with one change after the other."""
    import mutmut  # type: ignore[import-not-found]

    for kind in ("string", "fstring"):
        mutmut.mutations_by_type.pop(kind, None)
    source = (ROOT / file).read_text(encoding="utf-8")
    numbers = mutmut.list_mutations(mutmut.Context(source=source, filename=file))
    random.Random(1).shuffle(numbers)  # so that the first ones stand for all
    for number in numbers:
        if re.match(r"\s*\w+ = \"", number.line):  # a name for a text
            continue
        yield mutmut.mutate(mutmut.Context(source=source, filename=file, mutation_id=number))[0]


def forked(file: str, text: str | None, imports: str) -> int:
    """Test a change (None: the file as it is, and note what is imported) in another process: its number."""
    if pid := os.fork():
        return pid
    os.setsid()
    null = os.open(os.devnull, os.O_RDWR)
    os.dup2(null, 1)
    os.dup2(null, 2)
    if text is not None:
        sys.meta_path.insert(0, Changed(".".join(Path(file).with_suffix("").parts[1:]), text))
    code = int(pytest.main(["-x", "-p", "no:cacheprovider", *shlex.split(TESTS[file])]))
    if text is None:
        libraries = [name for name in sys.modules if not name.startswith(NOT_BEFORE) and not of_this_repository(name)]
        Path(imports).write_text(json.dumps(libraries))
    os._exit(code)


def of_this_repository(name: str) -> bool:
    file = Path(getattr(sys.modules[name], "__file__", None) or ROOT)
    return file.is_relative_to(ROOT) and "site-packages" not in file.parts


def survivors(file: str, seconds: float) -> tuple[list[str], int]:
    """Changes that no test noticed, and how many there were; those that take too long are noticed."""
    with tempfile.NamedTemporaryFile() as imports:
        begun = time.monotonic()
        _, code = os.waitpid(forked(file, None, imports.name), 0)
        limit = 30.0 + 5.0 * (time.monotonic() - begun)
        assert code == 0, f"{file}: its tests fail without a change"
        for name in json.loads(Path(imports.name).read_text()):
            with contextlib.suppress(Exception):
                importlib.import_module(name)
    _, code = os.waitpid(forked(file, (ROOT / file).read_text(encoding="utf-8"), ""), 0)
    assert code == 0, f"{file}: its tests fail in a forked process: every change would count as noticed"
    left, count = changes(file), 0
    running: dict[int, tuple[str, float]] = {}
    survived: list[str] = []
    end = time.monotonic() + seconds
    while True:
        while len(running) < (os.cpu_count() or 1) and time.monotonic() < end and (text := next(left, None)):
            running[forked(file, text, "")] = text, time.monotonic() + limit
            count += 1
        if not running:
            return survived, count
        pid, code = os.waitpid(-1, os.WNOHANG)
        if pid:
            text, _ = running.pop(pid)
            survived += [text] if code == 0 else []
        for late in [pid for pid, (_, until) in running.items() if time.monotonic() > until]:
            os.killpg(late, signal.SIGKILL)
        time.sleep(0.02)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="*", help="names of files without .py: by default all five")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="for each file: no new change after that")
    given = parser.parse_args()
    os.chdir(ROOT)
    good = True
    for file in TESTS:
        if given.files and Path(file).stem not in given.files:
            continue
        source = (ROOT / file).read_text(encoding="utf-8").splitlines()
        survived, count = survivors(file, given.seconds)
        for text in survived:
            print("\n".join(list(difflib.unified_diff(source, text.splitlines(), file, file, n=0, lineterm=""))[2:]))
        print(f"{file}: {count - len(survived)} of {count} changes noticed", flush=True)
        good &= len(survived) <= (1 - ENOUGH) * count
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
