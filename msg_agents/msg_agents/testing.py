# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""A pytest fixture that runs networks in a ROS domain of their own."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from msg_agents import run_network
from msg_agents.discovery.rtps import free_domain
from msg_analysis import Experiment, Run

Network = Callable[[str | Path | Experiment], Run]
"""What the fixture ``network`` gives: it runs an experiment, the file of one or an example, and returns the run."""


@pytest.fixture
def network(tmp_path: Path) -> Iterator[Network]:
    """A function that runs an experiment as a network, in a domain of its own; bags are in ``tmp_path``.

    See pytest for the parameters.
    """
    with free_domain() as domain:
        yield lambda experiment: run_network(experiment, tmp_path / "runs", domain=domain)
