"""What holds for every test."""

import ctypes
import functools
import gc
import itertools
import math
import os
import signal
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

# No test asserts a time: on a busy machine any example may be slow.
settings.register_profile("no deadline", deadline=None)
settings.load_profile("no deadline")

# A shell script has what it starts in the background ignore Ctrl-C, and so would all that the tests start.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# All that is imported and collected stays to the end: the collector of garbage need not look through it each time.
gc.disable()
OBJECTS_BETWEEN_COLLECTIONS = 20_000  # Python's 700 are for smaller programs

# Arrays of one test are made in the memory of those before it, which the C library would give back to the system.
if sys.platform == "linux":
    M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_THRESHOLD = -1, -2, -3  # of <malloc.h>
    for option, size in ((M_TRIM_THRESHOLD, 2**28), (M_TOP_PAD, 2**26), (M_MMAP_THRESHOLD, 2**25)):
        getattr(ctypes.CDLL(None), "mallopt", lambda *_: 0)(option, size)

WAITING = 0.6
"""Part of the time of all tests that those which wait take: of so many workers, they are the first tests."""

TESTS = Path(__file__).parent
MACHINE = "this machine: "
"""How the reason of a skipped test begins if nothing that can be installed would help."""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--skipped-to", type=Path, metavar="FILE", help="append what was skipped, and why, to FILE")
    parser.addoption(
        "--nothing-skipped", action="store_true", help=f"fail if a test is skipped, unless its reason is {MACHINE!r}"
    )


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Networks and other processes wait a good part of their time, so they run beside tests that compute, to the end.

    Each worker begins with an equal part of the list, the longest tests first. The first workers get what does not
    wait, but others take over from the ends of their parts: so what a module makes only once, the site, is at the
    beginning, and what only computes is last and keeps all cores busy.
    """
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    with_waiting = math.ceil(workers * WAITING)
    waiting = sorted((item for item in items if _waits(item.path)), key=_limit, reverse=True)
    modules = [list(module) for _, module in itertools.groupby(waiting, key=lambda item: item.path)]
    others = iter(sorted((item for item in items if not _waits(item.path)), key=_only_computes))
    ordered: list[pytest.Item] = []
    for worker in range(workers):
        if (place := worker - (workers - with_waiting)) >= 0:
            ordered += itertools.chain.from_iterable(modules[place::with_waiting])
        ordered += itertools.islice(others, max(0, len(items) * (worker + 1) // workers - len(ordered)))
    items[:] = [*ordered, *others]


def pytest_collection_finish() -> None:
    gc.freeze()
    gc.set_threshold(OBJECTS_BETWEEN_COLLECTIONS, *gc.get_threshold()[1:])
    gc.enable()


@functools.cache
def _waits(path: Path) -> bool:
    return path.relative_to(TESTS).parts[0] in ("integration", "agents")


def _only_computes(item: pytest.Item) -> bool:
    """It starts no command and no browser, and builds no site."""
    return item.path.relative_to(TESTS).parts[0] == "analysis" and "browser" not in item.path.stem


def _limit(item: pytest.Item) -> float:
    """Seconds that a test may take, where it needs or waits for longer than others."""
    mark = item.get_closest_marker("timeout")
    return mark.args[0] if mark else 0.0


def pytest_sessionfinish(session: pytest.Session) -> None:
    """On the process that reports: with xdist, not on the workers."""
    config = session.config
    reporter = config.pluginmanager.get_plugin("terminalreporter")
    if reporter is None or hasattr(config, "workerinput"):
        return
    reports = reporter.stats.get("skipped", [])
    reasons = Counter(str(report.longrepr[2]).removeprefix("Skipped: ") for report in reports)
    if to := config.getoption("--skipped-to"):
        to.parent.mkdir(parents=True, exist_ok=True)
        with to.open("a", encoding="utf-8") as file:
            file.writelines(f"  {count} skipped: {reason}\n" for reason, count in reasons.items())
    avoidable = [reason for reason in reasons if not reason.startswith(MACHINE)]
    if config.getoption("--nothing-skipped") and avoidable:
        reporter.write_line(f"skipped, but can run here: {'; '.join(avoidable)}", red=True)
        session.exitstatus = session.exitstatus or pytest.ExitCode.TESTS_FAILED


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """One for all pages of a worker."""
    from browser import chromium

    with chromium() as found:
        yield found


@pytest.fixture(scope="session")
def tab(browser: Any) -> Any:
    """A page of this browser, which is used again and again."""
    from browser import Tab

    return Tab(browser)
