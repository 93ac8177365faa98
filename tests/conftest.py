"""What holds for every test."""

from __future__ import annotations

import signal
from collections import Counter
from pathlib import Path

import pytest
from hypothesis import settings

# No test asserts a time: on a busy machine any example may be slow.
settings.register_profile("no deadline", deadline=None)
settings.load_profile("no deadline")

# A shell script has what it starts in the background ignore Ctrl-C, and so would all that the tests start.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

MACHINE = "this machine: "
"""How the reason of a skipped test begins if nothing that can be installed would help."""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--skipped-to", type=Path, metavar="FILE", help="append what was skipped, and why, to FILE")
    parser.addoption(
        "--nothing-skipped", action="store_true", help=f"fail if a test is skipped, unless its reason is {MACHINE!r}"
    )


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
