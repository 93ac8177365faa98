"""What a comparison says in sentences."""

import io

from rich.console import Console

from msg_analysis.report.terminal.verdict_text import order_statements, print_bags, print_blame, sentence

NAMES = ["agent 1", "agent 2", "agent 3"]


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


def shown(function, document):
    stream = io.StringIO()
    function(document, Console(file=stream, width=100))
    return " ".join(stream.getvalue().split())


def test_order_in_sentences():
    pairs = [pair(3, 2, 0.99999, True), pair(1, 2, 0.9951, None)]
    assert order_statements(order(pairs, [pairs[1]]), NAMES, "is more certain than") == [
        "Order, smallest measured error first: agent 3, agent 1, agent 2. 2 of 3 pairs can be told apart, all together "
        "at level 0.01.",
        "Agent 3 is more certain than agent 2 (confidence > 99.99 %).",
        "Agent 1 is more certain than agent 2 (confidence 99.51 %).",
        "Not told apart: agent 3 and agent 1.",
        "But predicted as equal: agent 1 is more certain than agent 2 (confidence 99.51 %).",
    ]
    files = order_statements(order([pair(3, 2, 0.999, False)]), ["a.json", "b.json", "c.json"], "beats")
    assert files[1] == "c.json beats b.json (confidence 99.90 %)."


def test_nothing_told_apart():
    (line,) = order_statements(order([]), NAMES, "is more certain than")
    assert "0 of 3 pairs can be told apart" in line


def test_blame_and_bags():
    assert sentence("agent 3 does not move") == "Agent 3 does not move."
    assert shown(print_blame, {"blame": [{"words": "all gains [x] are 2"}]}) == "All gains [x] are 2."
    assert shown(print_blame, {}) == shown(print_bags, {"bags": None}) == ""
    bag = {
        "bag": "torn[1]",
        "seed": 7,
        "simulated_time": 5.0,
        "system_error": {"measured": None, "z": None},
        "missing": 3,
        "complete": False,
        "verdict": "incomplete",
    }
    output = shown(print_bags, {"bags": [bag, bag | {"bag": "whole", "complete": True}]})
    assert output.endswith("Incomplete: torn[1]. Leave them out for a verdict on the others.")
