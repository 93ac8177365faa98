"""What a comparison says in sentences."""

from msg_analysis.report.comparison_text import furthest, order_statements, sentence

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


def test_order_in_sentences():
    pairs = [pair(3, 2, 0.99999, True), pair(1, 2, 0.9951, None)]
    assert order_statements(order(pairs, [pairs[1]]), NAMES, "has a smaller error than") == [
        "Order, smallest measured error first: agent 3, agent 1, agent 2. 2 of 3 pairs differ significantly "
        "(family-wise level 0.01).",
        "Agent 3 has a smaller error than agent 2 (confidence > 99.99 %).",
        "Agent 1 has a smaller error than agent 2 (confidence 99.51 %).",
        "Not significantly different: agent 3 and agent 1.",
        "Unexpected: agent 1 has a smaller error than agent 2 (confidence 99.51 %); the theory predicts equal errors.",
    ]
    files = order_statements(order([pair(3, 2, 0.999, False)]), ["a.json", "b.json", "c.json"], "beats")
    assert files[1] == "c.json beats b.json (confidence 99.90 %)."


def test_no_significant_difference():
    (line,) = order_statements(order([]), NAMES, "has a smaller error than")
    assert "0 of 3 pairs differ significantly" in line


def test_sentence():
    assert sentence("agent 3 does not move") == "Agent 3 does not move."


def test_the_largest_z_first():
    assert furthest([0.5, None, -3.0, 2.0], 3) == [2, 3, 0]
    assert furthest([], 3) == []
