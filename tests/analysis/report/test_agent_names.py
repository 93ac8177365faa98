"""Agents are shown by name wherever texts would show their numbers; in JSON they keep these."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from msg_analysis.api import Experiment, Run, write_report
from msg_analysis.cli.main import main
from msg_analysis.common.text import agent_name, agent_text, with_names
from msg_analysis.sweep.grid import load_sweep
from msg_analysis.sweep.results import axis_name, column_words

NAMES = ["Ulm", "Bonn", "Kiel"]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("the gain of agent 3 on agent 1", "the gain of agent Kiel on agent Ulm"),
        ("agent 2's noise variance", "agent Bonn's noise variance"),
        ("Agents 1, 2 and 3: 5 agents, agent 4", "Agents Ulm, Bonn and Kiel: 5 agents, agent 4"),
        ("agents too far behind: 2", "agents too far behind: 2"),
        ("too far behind: agent 2, agent 3", "too far behind: agent Bonn, agent Kiel"),
        ("slowest: agent 1, at step 2", "slowest: agent Ulm, at step 2"),
        ("expected agents 1 to 3; /agent_1/state; agent 1.5", "expected agents 1 to 3; /agent_1/state; agent 1.5"),
        ("the last 3 steps of all agents", "the last 3 steps of all agents"),
    ],
)
def test_names_in_sentences(text: str, expected: str) -> None:
    assert with_names(text, NAMES) == expected
    assert with_names(text, None) == text


def test_one_agent() -> None:
    assert (agent_name(2, NAMES), agent_name(2, None), agent_name(4, NAMES)) == ("Bonn", "2", "4")
    assert agent_text(2, NAMES) == "agent Bonn"


@pytest.fixture(scope="module")
def run() -> Run:
    document = {"name": "net", "names": NAMES, "problem": "tracking", "leaders": {"agents": ["Bonn"]}}
    return Experiment.parse(document | {"graphs": {"ring": {"cycle": [1, 2, 3]}}, "run": {"duration": 100}}).simulate()


def test_every_command(run: Run, tmp_path: Path) -> None:
    file, bag = tmp_path / "net.yaml", run.save(tmp_path / "bag")
    file.write_text(json.dumps(run.experiment.to_document()))
    commands = [
        ["predict", file], ["info", file], ["leaders", file, "--count", "2"], ["facts", file], ["compare", bag],
    ]  # fmt: skip
    for command in commands:
        texts, document = (
            CliRunner().invoke(main, [str(word) for word in [*command, *option]]).stdout for option in ([], ["--json"])
        )
        assert "Bonn" in texts, command
        assert "agent 2" not in texts, command
        assert json.loads(document)["names"] == NAMES, command
    assert json.loads(document)["leaders"] == [2]
    plan = CliRunner().invoke(main, ["plan", str(file)]).stdout
    assert "agent Kiel x 0.5" in plan
    saved = tmp_path / "saved.json"
    saved.write_text(document)
    assert "Bonn" in CliRunner().invoke(main, ["tabulate", str(saved)]).stdout
    table = tmp_path / "transient.csv"
    CliRunner().invoke(main, ["transient", str(file), "--times", "0,1", "--csv", str(table)])
    assert "mean of agent Kiel" in table.read_text().partition("\n")[0]


def test_notebooks_and_report(run: Run, tmp_path: Path) -> None:
    comparison = run.compare()
    selection = run.experiment.select_leaders(1)
    prediction = run.experiment.predict()
    shown = (comparison, prediction, selection, prediction.emulated, prediction.continuous, prediction.static)
    for text in (one._repr_markdown_() for one in shown):
        assert "Bonn" in text
    html = write_report(comparison, tmp_path / "report.html").read_text(encoding="utf-8")
    assert "the leader, agent Bonn, is pulled" in html
    assert "leader, agent Bonn hears Ulm, Kiel" in html
    assert "<td>Kiel</td>" in html
    assert "agent 2" not in html


def test_stages_of_a_search(run: Run) -> None:
    stages: list[str] = []
    run.experiment.select_leaders(2, method="swap", watch=lambda stage, *_: stages.append(stage))
    assert any(stage.startswith("greedy after agent ") for stage in stages)
    assert not any(character.isdigit() for stage in stages if "agent" in stage for character in stage)


def test_keys_of_a_sweep(tmp_path: Path) -> None:
    """Of the agents' noise and errors: in words by name, beside the key, which has the number."""
    file = tmp_path / "noise.yaml"
    document = {
        "experiment": {
            "name": "net",
            "names": NAMES,
            "graphs": {"ring": {"cycle": [1, 2, 3]}},
            "noise": {"process": [1, 1, 1]},
        },
        "over": {"noise.process[2]": [1.0, 2.0]},
    }
    file.write_text(json.dumps(document))
    sweep = load_sweep(file)
    assert axis_name("noise.process[2]", sweep.names) == "process noise of agent Bonn [noise.process[2]]"
    assert column_words("continuous.node_errors[3]", sweep.names) == "error of agent Kiel, continuous time"
    out = tmp_path / "out"
    result = CliRunner().invoke(main, ["sweep", str(file), "--out", str(out), "--column", "node_errors[3]"])
    assert result.exit_code == 0, result.output
    page = (out / "sweep.html").read_text(encoding="utf-8")
    assert "process noise of agent Bonn" in page
    assert "Error of agent Kiel over one key" in page
    assert "agent 2" not in page + (out / "figure.svg").read_text(encoding="utf-8")
    # Points that have other names have none together.
    document["over"] = {"names": [NAMES, NAMES[::-1]]}
    file.write_text(json.dumps(document))
    assert load_sweep(file).names is None
