# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""What is installed works without ROS. Run by ``colcon test`` in the workspace that has been built."""

from __future__ import annotations

import json
import os
import subprocess
from importlib import resources
from pathlib import Path

import pytest

import msg_analysis
from msg_analysis.experiment import examples

EXPERIMENT = """
name: pair
graphs: {edge: {path: [1, 2]}, line: {path: [1, 2]}}
switching: {generator: [[-1, 1], [1, -1]]}
"""


def test_executable(tmp_path: Path) -> None:
    """Two agents, gain 1, noise 1: d' = -2 d + noise of variance 2, so E d^2 = 1/2, of which each bears a quarter."""
    prefixes = os.environ["AMENT_PREFIX_PATH"].split(os.pathsep)
    (program,) = {
        found for prefix in prefixes if (found := Path(prefix) / "lib" / "msg_analysis" / "msg-analysis").is_file()
    }
    file = tmp_path / "pair.yaml"
    file.write_text(EXPERIMENT)
    for each in (program, program.parents[2] / "bin" / program.name):  # the second is on the PATH
        process = subprocess.run([each, "predict", file, "--json"], capture_output=True, text=True, timeout=60)
        assert process.returncode == 0, process.stderr
        error = json.loads(process.stdout)["continuous"]["system_error"]
        assert abs(error - 0.25) < 1e-12


def test_data_files() -> None:
    assert (resources.files(msg_analysis) / "messages/definitions/std_msgs/msg/Header.msg").is_file()
    assert (resources.files(msg_analysis) / "report/templates").is_dir()


def test_examples() -> None:
    assert "line_ring" in examples.names()


@pytest.mark.parametrize("name", examples.names())
def test_example(name: str) -> None:
    msg_analysis.Experiment.load(name).require_available()
