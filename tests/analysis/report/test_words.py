"""What is said of runs in sentences, in the head of a report, and with the names of agents."""

import dataclasses
import datetime
import json
from pathlib import Path

import pytest
from programs import run as call

from experiments import Experiment, Run, RunRecord, compare, line_ring, new_record, simulate
from msg_analysis import write_report
from msg_analysis.common.text import agent_name, agent_text, with_names
from msg_analysis.errors import InputError
from msg_analysis.inference.pool import compare_pooled
from msg_analysis.report.comparison_text import furthest, order_statements, sentence
from msg_analysis.report.list_pages import render_sweep
from msg_analysis.report.page import page_title, run_facts
from msg_analysis.report.sweep_plots import write_figure
from msg_analysis.sweeps.grid import load_sweep
from msg_analysis.sweeps.points import evaluate
from msg_analysis.sweeps.results import axis_name, column_words, evaluate_sweep, picture, rows_of

AGENTS = ["agent 1", "agent 2", "agent 3"]


def pair(better, worse, confidence, predicted):
    return {"better": better, "worse": worse, "confidence": confidence, "predicted": predicted}


def order(distinctions, contradictions=()):
    return {
        "ranking": [3, 1, 2],
        "level": 0.01,
        "pairs": 3,
        "distinguished": len(distinctions),
        "ties": [[3, 1]] if len(distinctions) < 3 else [],
        "contradictions": list(contradictions),
        "distinctions": distinctions,
    }


def test_order_in_sentences():
    pairs = [pair(3, 2, 0.99999, True), pair(1, 2, 0.9951, None)]
    assert order_statements(order(pairs, [pairs[1]]), AGENTS, "has a smaller error than") == [
        "Order, smallest measured error first: agent 3, agent 1, agent 2. 2 of 3 pairs differ significantly "
        "(family-wise level 0.01).",
        "Agent 3 has a smaller error than agent 2 (confidence > 99.99 %).",
        "Agent 1 has a smaller error than agent 2 (confidence 99.51 %).",
        "Not significantly different: agent 3 and agent 1.",
        "Unexpected: agent 1 has a smaller error than agent 2 (confidence 99.51 %); the theory predicts equal errors.",
    ]
    files = order_statements(order([pair(3, 2, 0.999, False)]), ["a.json", "b.json", "c.json"], "beats")
    assert files[1] == "c.json beats b.json (confidence 99.90 %)."


def test_order_without_differences_and_the_largest_z_first() -> None:
    (line,) = order_statements(order([]), AGENTS, "has a smaller error than")
    assert "0 of 3 pairs differ significantly" in line
    assert sentence("agent 3 does not move") == "Agent 3 does not move."
    assert furthest([0.5, None, -3.0, 2.0], 3) == [2, 3, 0]
    assert furthest([], 3) == []


PAIR = {"name": "pair", "graphs": {"pair": {"path": [1, 2]}}, "switching": {}}
RUN = {"replicas": 1, "seed": 3, "start": "zero"}
NOON = datetime.datetime(2026, 11, 25, 12, 0, 59, tzinfo=datetime.UTC)


def begun(at: datetime.datetime = NOON, **changes: object) -> Run:
    found = simulate(line_ring(**PAIR, run=RUN | changes))
    return dataclasses.replace(found, record=dataclasses.replace(found.record, started=at))


def test_one_run() -> None:
    comparison = compare(begun())
    assert page_title(comparison) == f"✓ pair, seed 3, 2026-11-25 12:00: {comparison.verdict}"
    assert run_facts(comparison, 12.34) == [
        ("seed", "3"),
        ("date", "2026-11-25 12:00 UTC"),
        ("duration", "20 units of time, 400 steps of 0.05, in 12.3 s"),
        ("pace", "lockstep"),
    ]
    *others, pace = run_facts(compare(begun(pace="realtime", speed=5)), None)
    assert [name for name, _ in others] == ["seed", "date", "duration"]
    assert pace == ("pace", "real time, 5 units of time per second")


def test_several_runs() -> None:
    later = NOON + datetime.timedelta(days=1)
    comparison = compare_pooled([("a", begun(later)), ("b", begun(seed=4))])
    assert page_title(comparison).startswith("✓ pair, 2 runs, seeds 3, 4, 2026-11-25 12:00: ")
    facts = dict(run_facts(comparison, None))
    assert facts["seeds"] == "3, 4"
    assert facts["date"] == "2026-11-25 12:00 to 2026-11-26 12:00 UTC"
    assert facts["duration"] == "20 units of time, 400 steps of 0.05 each"


def test_the_record_keeps_its_date() -> None:
    record = new_record(line_ring(**PAIR, run=RUN))
    again = RunRecord.from_json(record.to_json(), "here")
    assert again.started == record.started
    assert again.to_json() == record.to_json()
    local = record.to_json().replace(record.started.isoformat(), "2026-11-25T13:00:59+01:00")
    assert RunRecord.from_json(local, "here").started == NOON
    for wrong in (
        record.to_json().replace(record.started.isoformat(), "yesterday"),
        record.to_json().replace('"started"', '"other"'),
    ):
        with pytest.raises(InputError, match="not a run record"):
            RunRecord.from_json(wrong, "here")


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
def named_run() -> Run:
    document = {"name": "net", "names": NAMES, "problem": "tracking", "leaders": {"agents": ["Bonn"]}}
    return Experiment.parse(document | {"graphs": {"ring": {"cycle": [1, 2, 3]}}, "run": {"duration": 100}}).simulate()


def test_every_command(named_run: Run, tmp_path: Path) -> None:
    file, bag = tmp_path / "net.yaml", named_run.save(tmp_path / "bag")
    file.write_text(json.dumps(named_run.experiment.to_document()))
    commands = [
        ["predict", file], ["info", file], ["leaders", file, "--count", "2"], ["facts", file], ["compare", bag],
    ]  # fmt: skip
    for command in commands:
        texts, document = (call("msg-analysis", *command, *option).stdout for option in ([], ["--json"]))
        assert "Bonn" in texts, command
        assert "agent 2" not in texts, command
        assert json.loads(document)["names"] == NAMES, command
    assert json.loads(document)["leaders"] == [2]
    assert "agent Kiel x 0.5" in call("msg-analysis", "plan", file).stdout
    saved = tmp_path / "saved.json"
    saved.write_text(document)
    assert "Bonn" in call("msg-analysis", "tabulate", saved).stdout
    table = tmp_path / "transient.csv"
    call("msg-analysis", "transient", file, "--times", "0,1", "--csv", table)
    assert "mean of agent Kiel" in table.read_text().partition("\n")[0]


def test_notebooks_and_report(named_run: Run, tmp_path: Path) -> None:
    comparison = named_run.compare()
    selection = named_run.experiment.leaders(1)
    prediction = named_run.experiment.predict()
    shown = (comparison, prediction, selection, prediction.emulated, prediction.continuous, prediction.static)
    for text in (one._repr_markdown_() for one in shown):
        assert "Bonn" in text
    html = write_report(comparison, tmp_path / "report.html").read_text(encoding="utf-8")
    assert "the leader, agent Bonn, is pulled" in html
    assert "leader, agent Bonn receives from Ulm, Kiel" in html
    assert "<td>Kiel</td>" in html
    assert "agent 2" not in html


def test_stages_of_a_search(named_run: Run) -> None:
    stages: list[str] = []
    named_run.experiment.leaders(2, method="swap", watch=lambda stage, *_: stages.append(stage))
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
    outcomes = [evaluate(point.job) for point in sweep.points]
    rows, column = rows_of(sweep, outcomes, evaluate_sweep(outcomes, 0.01)), "node_errors[3]"
    page = render_sweep(sweep, rows, column, "two points", None)
    assert "process noise of agent Bonn" in page
    assert "Error of agent Kiel over one key" in page
    (figure, _) = write_figure(picture(sweep, rows, column), "noise", tmp_path)
    assert "agent 2" not in page + figure.read_text(encoding="utf-8")
    # Points that have other names have none together.
    document["over"] = {"names": [NAMES, NAMES[::-1]]}
    file.write_text(json.dumps(document))
    assert load_sweep(file).names is None
