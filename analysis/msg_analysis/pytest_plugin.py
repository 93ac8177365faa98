# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Plugin of pytest: fixtures ``assert_agrees`` and ``accept``, and the options that say where their files go."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from msg_analysis.inference.acceptance import Acceptance
    from msg_analysis.inference.comparison import Comparison
    from msg_analysis.inference.log_verdict import LogComparison


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options."""
    group = parser.getgroup("msg_analysis", "tests of networks and robots")
    group.addoption("--msg-report", metavar="DIR", help="write a page of every comparison of `assert_agrees`")
    group.addoption("--msg-state", metavar="DIR", help="keep the runs of `accept` from one call of pytest to the next")
    group.addoption("--msg-revision", metavar="TEXT", help="what is tested, as a commit: only its runs are kept")


@pytest.fixture
def assert_agrees(request: pytest.FixtureRequest) -> Callable[..., Comparison | LogComparison]:
    """``msg_analysis.testing.assert_agrees``; with ``--msg-report DIR``, a page DIR/TEST.html is written before."""
    from msg_analysis.testing import assert_agrees as check

    given = request.config.getoption("--msg-report")
    return functools.partial(check, report=Path(given) / f"{_file_name(request)}.html" if given else None)


@pytest.fixture
def accept(request: pytest.FixtureRequest, record_property: Callable[[str, object], None]) -> Callable[..., Acceptance]:
    """``msg_analysis.testing.accept``; the runs are in a file of the folder of ``--msg-state``; open claims skip."""
    from msg_analysis.testing import accept as repeat

    folder, revision = (request.config.getoption(option) for option in ("--msg-state", "--msg-revision"))

    def call(metric: Any, **arguments: Any) -> Acceptance:
        if folder:
            Path(folder).mkdir(parents=True, exist_ok=True)
            name = "".join(f"_{arguments[key]}" for key in ("name",) if key in arguments)
            arguments = {"state": Path(folder) / f"{_file_name(request)}{name}.json"} | arguments
        found = repeat(metric, **({"revision": revision} | arguments))
        record_property("acceptance", found.words)
        if found.decision == "open":
            pytest.skip(found.words)
        return found

    return call


def _file_name(request: pytest.FixtureRequest) -> str:
    """The test, as the name of a file."""
    return re.sub(r"[^\w.-]+", "_", request.node.nodeid)
