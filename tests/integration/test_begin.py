"""The first commands of a user with real processes: the demo, and a new experiment."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from msg_analysis.bags.reading import read_record

SHORT = ("--duration", "2", "--processes", "1", "--no-analyse", "--json", "--out")


def test_demo(network: Any) -> None:
    """An example that needs no file."""
    result = network.completed(network.start("demo", *SHORT, network.directory / "runs"))
    assert read_record(Path(result["bag"])).experiment.name == "line_ring"


def test_new_experiment(network: Any) -> None:
    file = network.directory / "lab.yaml"
    new = network.start("new", file, "--agents", "4", "--graph", "star", "--loss", "0.2")
    assert (*new.communicate(timeout=60), new.returncode)[1:] == ("", 0)
    result = network.completed(network.start("run", file, *SHORT, network.directory / "runs"))
    assert read_record(Path(result["bag"])).experiment.agents == 4
