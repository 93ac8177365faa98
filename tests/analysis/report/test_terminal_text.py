"""Tables for a terminal: they show the numbers of the document, also where some are missing."""

import io
import re
from functools import partial
from typing import Any

import pytest
from rich.console import Console

from msg_analysis.experiment.experiment import Experiment
from msg_analysis.experiment.protocols import ProtocolInfo
from msg_analysis.report import comparison_text, tables, theory_text
from msg_analysis.report.documents import describe_experiment
from msg_analysis.report.drawings import explain


def shown(function: Any, document: dict[str, Any], **options: bool) -> str:
    stream = io.StringIO()
    function(document, Console(file=stream, width=120, color_system=None, highlight=False), **options)
    return stream.getvalue()


compared = partial(shown, comparison_text.print_comparison)


def estimate(measured: float | None) -> dict[str, Any]:
    known = measured is not None
    return {
        "measured": measured,
        "standard_error": 0.5 if known else None,
        "predicted": 1.25,
        "z": 3.14159 if known else None,
        "interval": [1.5, 2.5] if known else [None, None],
    }


def comparison(verdict: str, agents: int, measured: float | None) -> dict[str, Any]:
    test = {"name": "switching", "p": 0.0001, "p_adjusted": 0.001, "rejected": True}
    untested = {"name": "covariance [m > 20]", "p": None, "p_adjusted": None, "rejected": False}
    return {
        "verdict": verdict,
        "completeness": {"expected": 12, "received": 11, "missing": 1, "duplicates": 2, "out_of_order": 3},
        "steps": 3,
        "simulated_time": 0.75,
        "system_error": estimate(measured),
        "node_errors": [estimate(measured) for _ in range(agents)],
        "continuous": {"system_error": None},
        "batch_means": {"interval": [None, None] if measured is None else [1.0, 3.0]},
        "tests": [untested, test],
        "level": 0.01,
    }


def test_comparison() -> None:
    output = compared(comparison("disagrees", 3, 2.0))
    assert output.startswith("The run disagrees with the prediction.")
    assert "11 of 12 states in 3 steps (0.75 units of time): 1 missing, 2 duplicates, 3 out of order" in output
    assert output.count("1.5 .. 2.5") == 4
    assert "+3.14" in output
    assert "agent 3" in output
    lines = output.splitlines()
    place = lines.index("1 of 1 tests rejected (smallest adjusted p 0.001; family-wise false-alarm rate 1 %)")
    (rejected,) = (line for line in lines if "0.0001" in line)
    assert rejected.split() == ["switching", "0.0001", "0.001", "rejected"]
    assert place < lines.index(rejected) < lines.index(next(line for line in lines if line.startswith("system")))
    assert "covariance [m > 20]" not in output
    everything = compared(comparison("disagrees", 3, 2.0), verbose=True)
    (untested,) = (line for line in everything.splitlines() if "covariance [m > 20]" in line)
    assert untested.endswith("not tested  ")
    tests = [{"name": f"test {i}", "p": 0.0, "p_adjusted": 0.0, "rejected": i % 2 == 0} for i in range(100)]
    output = compared(comparison("disagrees", 2, 2.0) | {"tests": tests})
    assert [f"test {i}  " in output for i in range(100)] == [i % 2 == 0 for i in range(100)]


def test_a_run_that_agrees_takes_ten_lines() -> None:
    """Counts that are 0 and tests that are ok are not listed; all is there with ``verbose``."""
    tests = [{"name": f"test {i}", "p": 0.8, "p_adjusted": 0.77, "rejected": False} for i in range(21)]
    whole = {"expected": 12, "received": 12, "missing": 0, "duplicates": 0, "out_of_order": 0}
    document = comparison("agrees", 5, 2.0) | {"tests": tests, "completeness": whole}
    lines = compared(document).splitlines()
    assert len(lines) <= 10
    assert "12 of 12 states in 3 steps (0.75 units of time)" in lines
    assert "21 of 21 tests ok (smallest adjusted p 0.77)" in lines
    everything = compared(document, verbose=True)
    assert sum(f"test {i}  " in everything for i in range(21)) == 21
    assert "Model-free estimate of the system error (batch means): 2 ± 1 (95 %)" in everything


def test_rejected_messages() -> None:
    entry = {"node": "agent_1", "topic": "[red]graph", "reason": "other run", "count": 1234}
    output = compared(comparison("agrees", 2, 2.0) | {"rejected_messages": [entry]})
    (line,) = (line for line in output.splitlines() if "1234" in line)
    assert line.split() == ["agent_1", "[red]graph", "other", "run", "1234"]
    assert "Rejected" not in compared(comparison("agrees", 2, 2.0) | {"rejected_messages": []})


def test_causes_and_bags() -> None:
    bag = {
        "bag": "torn[1]",
        "seed": 7,
        "simulated_time": 5.0,
        "system_error": {"measured": None, "z": None},
        "missing": 3,
        "complete": False,
        "verdict": "incomplete",
    }
    document = comparison("disagrees", 2, 2.0)
    document |= {"causes": [{"words": "all gains [x] are 2"}], "bags": [bag, bag | {"bag": "whole", "complete": True}]}
    output = compared(document)
    assert output.startswith("The runs disagree with the prediction.")
    assert "All gains [x] are 2." in output
    assert "Incomplete: torn[1]. Leave them out for a verdict on the others." in output


def test_comparison_without_numbers() -> None:
    output = compared(comparison("incomplete", 2, None))
    assert output.startswith("No verdict: the data are incomplete.")
    assert "nan" not in output.lower()


def test_of_many_agents_the_five_furthest_from_the_prediction_are_shown() -> None:
    document = comparison("agrees", 100, 2.0)
    for agent, error in enumerate(document["node_errors"], start=1):
        error["z"] = {10: -4.0, 20: 3.5, 30: 3.0, 40: 2.5, 50: 2.2}.get(agent, 1.0)
    output = compared(document)
    assert re.findall(r"^agent (\d+)", output, re.MULTILINE) == ["10", "20", "30", "40", "50"]
    words = " ".join(output.split())
    assert "95 of 100 agent errors have the prediction in their 95 % intervals; shown are the 5 that are" in words
    everything = compared(document, verbose=True)
    assert len(re.findall(r"^agent ", everything, re.MULTILINE)) == 100


def test_prediction() -> None:
    law = {"system_error": 3.5, "node_errors": [1.5, 2.0], "system_certainty": 2 / 7, "node_certainty": [2 / 3, 0.5]}
    document = {"agents": 2, "modes": ["[red]", "b"], "stationary": [0.25, 0.75]}
    document |= {"continuous": law, "emulated": law, "static": None, "fourth_moment": {"finite": True}}
    document["disconnected"] = ["b"]
    output = shown(theory_text.print_prediction, document)
    parts = (
        "[red]",
        "continuous time",
        "steps of the run",
        "3.5",
        "0.285714",
        "0.25",
        "infinite, since b alone does not connect all agents",
    )
    assert [part for part in parts if part not in output] == []


DOCUMENT: dict[str, Any] = {
    "name": "walk",
    "problem": "tracking",
    "graphs": {
        "line": {"path": [1, 2, 3, 4]},
        "arcs": {"arcs": [[1, 2, 0.5], [2, 3], [3, 1]]},
        "ring": {"cycle": [1, 2, 3, 4]},
    },
    "switching": {"generator": [[-1, 0.5, 0.5], [2, -2, 0], [4, 0, -4]]},
    "leaders": {"agents": [4], "gain": "inf"},
    "run": {"dt": 0.05, "duration": 50, "replicas": 2},
}


def test_experiment_explained() -> None:
    document = describe_experiment(Experiment.parse(DOCUMENT))
    line, arcs, ring = document["graphs"]
    assert (document["agents"], document["run"]["steps"], document["unavailable"]) == (4, 1000, [])
    assert [tuple(edge) for edge in line["edges"]] == [(1, 2, 1.0), (2, 3, 1.0), (3, 4, 1.0)]
    assert arcs["edges"] is None
    assert sorted(tuple(arc) for arc in arcs["arcs"]) == [(1, 2, 0.5), (2, 3, 1.0), (3, 1, 1.0)]
    assert [graph["mean_holding_time"] for graph in document["graphs"]] == [1.0, 0.5, 0.25]
    assert line["algebraic_connectivity"] == pytest.approx(2 - 2**0.5)  # of a path of four
    assert ring["algebraic_connectivity"] == pytest.approx(2.0)  # of a ring of four
    shares = [1, 0.25, 0.125]  # detailed balance: share times rate is equal both ways
    assert [graph["stationary"] for graph in document["graphs"]] == pytest.approx([s / sum(shares) for s in shares])
    assert document["memory"]["states"] == 1001 * 4 * 2 * 8
    (alone,) = describe_experiment(Experiment.parse({"name": "one", "graphs": {"line": {"path": [1, 2]}}}))["graphs"]
    assert (alone["mean_holding_time"], alone["stationary"]) == (None, 1.0)  # it is never left
    output = shown(tables.print_experiment, document)
    for part in ("tracking of 4 agents in continuous time", "gain inf", "1000 of 0.05", "1>2 (0.5)", "1-2, 2-3, 3-4"):
        assert part in output


def test_experiment_that_cannot_be_run_here() -> None:
    """One of a bag, whose protocol is not installed."""
    used = ProtocolInfo("mine", "pack", "1.2", linear=True)
    what = Experiment.parse(DOCUMENT | {"protocol": {"name": "mine"}}, recorded=used)
    text = shown(tables.print_experiment, describe_experiment(what))
    assert 'protocol.name: "mine": expected an available protocol' in text


def test_noise_by_graph_and_delay_explained() -> None:
    """Limits of the graphs alone would say nothing about steps with a delay."""
    gains = {"line": 1.0, "ring": [0.5, 1.0, 1.0, 2.0], "arcs": [[1.0, 0.0, 0.0, 0.5]] * 4}
    document = describe_experiment(Experiment.parse(DOCUMENT | {"noise": {"process": gains, "delay": 2}}))
    assert document["stability_limit"] is None
    assert document["predicted_system_error"] > 0
    output = " ".join(shown(tables.print_experiment, document).split())
    assert "line: 1.0; ring: [0.5, 1.0, 1.0, 2.0]; arcs: matrix 4 x 4" in output
    assert "delay 2" in output


def test_bag() -> None:
    completeness = {"expected": 4, "received": 3, "missing": 1, "duplicates": 0, "out_of_order": 0}
    document = {
        "bag": "[bold]bag",
        "run": "d3ba43f6",
        "experiment": "small",
        "seed": 1,
        "agents": 2,
        "replicas": 1,
        "steps": 1,
        "simulated_time": 0.05,
        "completeness": completeness
        | {"missing_modes": 0, "refused": {"other run": 5}, "complete": False, "stretch": [1, 1]},
        "recording": 4711,
        "problem": None,
        "topics": [{"name": f"/[red]{i}", "type": "pkg/msg/Kind", "messages": i} for i in range(14)],
        "files": [
            {"name": "log.txt", "size": 1234567},
            {
                "name": "bag_0.mcap",
                "size": 3,
                "messages": 8,
                "compression": "lz4",
                "torn": "cut off",
                "damaged_chunks": 2,
                "lost_messages": 77,
                "problem": None,
            },
        ],
        "versions": {"numpy": "2.0"},
    }
    output = " ".join(shown(tables.print_bag, document).split())
    for part in (
        *("[bold]bag", "d3ba43f6", "incomplete: 3 of 4, 1 missing", "5: other run", "1.23 MB", "2.0"),
        *(
            "process 4711",
            "steps 1 to 1; errors are computed only from step 0 on",
            "/[red]11, 11 messages, pkg/msg/Kind",
        ),
        *("and 2 more with 25 messages", "8 messages, lz4, torn: cut off", "2 damaged chunks, 77 messages"),
    ):
        assert part in output
    nothing = dict.fromkeys(document) | {"bag": "b", "problem": "no [run]", "topics": [], "files": [], "versions": {}}
    assert "no [run]" in shown(tables.print_bag, nothing)


def test_real_time() -> None:
    """Timing and laws are shown; missed deadlines stand in the line of the verdict."""
    quantiles = {"p50": 0.1, "p95": 2.0, "p99": 30.0, "max": None}
    error = estimate(2.0)
    law = {"system_error": error, "supported": None, "why": "because"}
    timing = {
        "period_ms": 10.0,
        **dict.fromkeys(("lateness_ms", "jitter_ms", "staleness_ms", "staleness_steps"), quantiles),
        "deadlines": {"steps": 1000, "missed": 73, "share": 0.073},
        "ideal_uses": {"uses": 400, "ideal": 300, "share": 0.75},
        "outdated_graph": {"steps": 1, "share": 0.00001},
        "never_received": 4,
    }
    laws = {"pattern": law | {"supported": True}, "sequential": law, "continuous": law | {"supported": False}}
    document = comparison("agrees", 3, 2.0) | {"timing": timing, "laws": laws | {"why": "the reasons"}}
    document["law"] = "pattern"
    document["real_time"] = {"follows_model": True, "prediction": False, "missed": 0.073, "max_missed": 0.1}
    short = compared(document)
    assert short.startswith(
        "The agents follow the model, given what they received; the prediction for real time is not"
    )
    assert "is not supported; 7.3 % of the deadlines were missed." in " ".join(short.split())
    assert "the reasons" in short
    assert "lateness [ms]" not in short
    output = compared(document, verbose=True)
    for part in ("lateness [ms]", "period jitter [ms]", "73 of 1000 (7.3 %)", "1 of 1000 (less than 0.01 %)"):
        assert part in output
    assert re.search(r"neighbour values as recent as with ideal timers +75 %", output)
    assert "neighbours before their first message" in output
    assert output.count("supported") == 3
    assert "not decided" in output
    assert "the reasons" in output
    lockstep = compared(comparison("agrees", 3, 2.0), verbose=True)
    assert "Timing" not in lockstep


def test_losses_by_link() -> None:
    loss = {"default": 0.2, "edges": [[2, 3, 0.6]], "arcs": [[1, 2, 0.05]]}
    document = describe_experiment(Experiment.parse(DOCUMENT | {"noise": {"loss": loss, "burst": 5}}))
    output = " ".join(shown(tables.print_experiment, document).split())
    assert "loss 0.2 (2-3: 0.6, 1>2: 0.05), on_loss own, burst 5.0, delay 0" in output


@pytest.mark.parametrize(
    ("noise", "words"),
    [
        ({"loss": 0.3}, "; 30 % of the messages are lost."),
        ({"loss": 0.3, "burst": 4}, "; 30 % of the messages are lost, on average 4 of a link in a row."),
        (
            {"loss": {"default": 0.1, "edges": [[1, 2, 0.5]]}, "on_loss": "hold"},
            "; 10 % of the messages are lost, and 50 % of those of 1 link, and the last received value takes the "
            "place of a lost one.",
        ),
        (
            {"loss": {"arcs": [[1, 2, 0.5], [2, 3, 0.25]]}, "delay": 2},
            "; 0 % of the messages are lost, and 25 to 50 % of those of 2 links; received values are 2 steps old.",
        ),
    ],
)
def test_what_happens_to_messages_explained(noise: dict[str, Any], words: str) -> None:
    assert any(sentence.endswith(words) for sentence in explain(Experiment.parse(DOCUMENT | {"noise": noise})))
