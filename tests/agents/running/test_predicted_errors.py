"""What is predicted of a run over a channel, against numbers of an independent prototype (line/ring, rate 0.5)."""

from __future__ import annotations

from typing import Any

import pytest

from msg_agents.channel.channel_file import Channel
from msg_agents.run.run_channel import predicted_errors
from msg_analysis.experiment.experiment import Experiment

TWO_HOSTS = {"left": {"agents": [1, 2]}, "right": {"agents": ["3-5"]}}


def line_ring(**run: Any) -> Experiment:
    return Experiment.parse(
        {
            "name": "line_ring",
            "problem": "consensus",
            "time": "continuous",
            "graphs": {"line": {"path": [1, 2, 3, 4, 5]}, "ring": {"cycle": [1, 2, 3, 4, 5]}},
            "switching": {"generator": [[-0.5, 0.5], [0.5, -0.5]]},
            "run": {"dt": 0.05, "duration": 10, "replicas": 1, "seed": 1, "pace": "realtime"} | run,
        }
    )


@pytest.mark.parametrize(
    ("channel", "expected"),
    [
        ({}, 1.419874),
        ({"default": {"loss": 0.2}}, 1.416858),
        ({"default": {"loss": 0.5}, "recorder": "clean"}, 1.411983),
        ({"default": {"loss": 0.2}, "hosts": TWO_HOSTS}, 1.420236),
        ({"default": {"loss": 0.8}, "hosts": TWO_HOSTS}, 1.446306),
    ],
)
def test_the_last_value_heard(channel: dict[str, Any], expected: float) -> None:
    """The prototype has the agents step in the order of their numbers, which moves the third digit after the point."""
    experiment = line_ring()
    predicted = predicted_errors(Channel.parse(channel, experiment), experiment)
    assert predicted is not None
    assert predicted["system_error"] == pytest.approx(expected, abs=1e-3)
    assert sum(predicted["node_errors"]) == pytest.approx(predicted["system_error"])


@pytest.mark.parametrize(
    ("channel", "run"),
    [
        ({"default": {"loss": 0.2}}, {"pace": "lockstep"}),
        ({"default": {"loss": 0.2}}, {"delivery": "reliable"}),
        ({"default": {"loss": 0.2, "burst": 4}}, {}),
        ({"default": {"loss": 0.2}, "graph": True}, {}),
    ],
)
def test_where_something_else_decides(channel: dict[str, Any], run: dict[str, Any]) -> None:
    experiment = line_ring(**run)
    assert predicted_errors(Channel.parse(channel, experiment), experiment) is None
