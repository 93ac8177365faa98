"""Losses of messages: the section of the file, the law of bursts, and the fate of a message without those before it."""

from typing import Any

import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st

from experiments import Experiment, line_ring
from msg_analysis.experiment.problems import ExperimentError
from msg_analysis.model.reception import Air, Losses, loss_probabilities

BLOCK = 256


def lossy(noise: dict[str, Any], **changes: Any) -> Experiment:
    return line_ring(**{"graphs": {"a": {"path": [1, 2, 3]}, "b": {"arcs": [[3, 1]]}}, "noise": noise} | changes)


# The section


def test_one_number_for_all_links_or_names() -> None:
    what = lossy({"loss": 0.2})
    assert what.loss.tolist() == [[0, 0.2, 0.2], [0.2, 0, 0.2], [0.2, 0.2, 0]]
    assert what.to_document()["noise"]["loss"] == 0.2
    assert what.noise.loss.any
    assert not what.noise.holds
    assert not lossy({"on_loss": "hold"}).noise.holds
    what = lossy({"loss": {"edges": [["n", "e", 0.3]], "arcs": [["s", 1, 0.5]]}}, names=["n", "e", "s"])
    assert what.loss.tolist() == [[0, 0.3, 0.5], [0.3, 0, 0], [0, 0, 0]]
    assert what.to_document()["noise"]["loss"] == {"default": 0.0, "edges": [[1, 2, 0.3]], "arcs": [[3, 1, 0.5]]}


def test_by_link() -> None:
    """An arc [1, 2, p] is for messages from agent 1 to agent 2: column 1, row 2."""
    loss = {"default": 0.1, "arcs": [[1, 2, 0.3], [3, 1, 0]], "edges": [[2, 3, 0.5]]}
    what = lossy({"loss": loss, "on_loss": "hold", "burst": 4})
    assert what.loss.tolist() == [[0, 0.1, 0.0], [0.3, 0, 0.5], [0.1, 0.5, 0]]
    document = what.to_document()
    assert document["noise"] | loss == document["noise"] | document["noise"]["loss"]
    assert (document["noise"]["on_loss"], document["noise"]["burst"]) == ("hold", 4.0)
    assert Experiment.parse(document) == what
    assert Experiment.parse(document).to_document() == document
    assert lossy({"loss": {"arcs": [[1, 2, 0]]}}).noise.loss.any is False


def test_in_discrete_time_an_agent_hears_all_that_reach_it() -> None:
    document = {"time": "discrete", "switching": {"transition": [[0.5, 0.5], [0.5, 0.5]]}, "run": {"dt": 1}}
    what = lossy({"loss": {"arcs": [[1, 3, 0.5]]}}, **document)
    assert what.loss[2, 0] == 0.5
    line = {"a": {"path": [1, 2, 3]}, "b": {"path": [1, 2, 3]}}
    with pytest.raises(ExperimentError, match=r"expected agents of which 3 hears 1 in some graph"):
        lossy({"loss": {"arcs": [[1, 3, 0.5]]}}, graphs=line)


@pytest.mark.parametrize(
    ("noise", "expected"),
    [
        ({"loss": True}, "noise.loss: true: expected a probability, or keys with probabilities: default, edges, arcs"),
        ({"loss": [0.1]}, "noise.loss: [0.1]: expected a probability, or keys"),
        ({"loss": {"default": 1}}, "noise.loss.default: 1: expected a number < 1"),
        (
            {"loss": {"defualt": 1}},
            "noise.loss.defualt: unknown key: expected one of default, edges, arcs: did you mean",
        ),
        ({"loss": {"arcs": [[1, 2]]}}, "noise.loss.arcs[1]: [1, 2]: expected [agent, agent, probability], agents by"),
        ({"loss": {"arcs": [[1, 2, 1]]}}, "noise.loss.arcs[1]: [1, 2, 1]: expected [agent, agent, probability]"),
        ({"loss": {"arcs": [[0, 2, 0.1]]}}, "noise.loss.arcs[1]: [0, 2, 0.1]: expected [agent, agent, probability]"),
        (
            {"loss": {"arcs": [[2, 2, 0.1]]}},
            "noise.loss.arcs: [2, 2]: expected agents of which 2 hears 2 in some graph",
        ),
        ({"loss": {"arcs": [[9, 2, 0.1]]}}, "noise.loss.arcs: [9, 2]: expected agents of which 2 hears 9"),
        ({"loss": {"arcs": [[1, 3, 0.1]]}}, "noise.loss.arcs: [1, 3]: expected agents of which 3 hears 1"),
        ({"loss": {"edges": [["a", 2, 0.1]]}}, 'noise.loss.edges: "a": expected a number, since no agent is named'),
        (
            {"loss": {"arcs": [[1, 2, 0.1]], "edges": [[1, 2, 0.3]]}},
            "noise.loss.edges: [1, 2]: expected every link once, in each direction: remove one",
        ),
        ({"on_loss": "keep"}, "noise.on_loss: \"keep\": expected 'own' or 'hold'"),
        ({"burst": 0.5}, "noise.burst: 0.5: expected a number >= 1"),
        ({"burst": 1e7}, "noise.burst: 10000000.0: expected a number <= 1e+06"),
        (
            {"loss": 0.75, "burst": 3},
            "noise.burst: 3.0: expected more than p / (1 - p) = 3, with the loss p = 0.75: raise it, or lower",
        ),
        (
            {"loss": {"arcs": [[1, 2, 0.9]]}, "burst": 5},
            "noise.burst: 5.0: expected more than p / (1 - p) = 9, with the loss of 1 to 2 p = 0.9",
        ),
    ],
    ids=str,
)
def test_mistakes(noise: dict[str, Any], expected: str) -> None:
    with pytest.raises(ExperimentError) as caught:
        lossy(noise)
    assert len(caught.value.problems) == 1
    assert caught.value.problems[0].startswith(expected), caught.value.problems[0]


# The law


@pytest.mark.parametrize(
    ("loss", "burst"),
    [(p, b) for p in (0.1, 0.4, 0.55) for b in (None, 1.0, 1.6, 5.0, 40.0) if b is None or b > p / (1 - p)],
)
def test_the_law_of_bursts(loss: float, burst: float | None) -> None:
    """Pairs of fates of successive messages against the chain, and its stationary law: chi-square with 3 degrees."""
    # Pairs that do not overlap, far enough apart to be nearly independent. p > 1e-4 in each of the 14 cases: a right
    # program fails with probability about 1.4e-3.
    what = lossy({"loss": loss} | ({} if burst is None else {"burst": burst}), run={"seed": 3})
    chain = Losses(what)
    lost = np.concatenate([chain.block(0, 1, number) for number in range(400)])
    stay = loss if burst is None else 1 - 1 / burst
    enter = loss if burst is None else loss * (1 - stay) / (1 - loss)
    apart = 2 + int(np.ceil(12 / (1 - abs(stay - enter)))) if stay != enter else 2
    first, second = lost[::apart][: (len(lost) - 1) // apart], lost[1::apart][: (len(lost) - 1) // apart]
    counts = np.bincount(2 * first + second, minlength=4)
    expected = np.array([(1 - loss) * (1 - enter), (1 - loss) * enter, loss * (1 - stay), loss * stay])
    there = expected > 1e-12
    assert not counts[~there].any()
    statistic = ((counts - len(first) * expected)[there] ** 2 / (len(first) * expected[there])).sum()
    assert scipy.stats.chi2.sf(statistic, there.sum() - 1) > 1e-4
    runs = np.diff(np.flatnonzero(np.diff(np.concatenate([[0], lost, [0]]))))[::2]
    mean = burst if burst is not None else 1 / (1 - loss)
    assert runs.mean() == pytest.approx(mean, abs=5 * max(runs.std(), 1e-9) / np.sqrt(len(runs)))


NOISES = st.one_of(
    st.builds(lambda p: {"loss": p}, st.floats(0.01, 0.95)),
    st.builds(lambda p, b: {"loss": p, "burst": p / (1 - p) * 1.01 + b}, st.floats(0.01, 0.95), st.floats(1, 600)),
    st.builds(lambda p: {"loss": p, "burst": 1.0}, st.floats(0.01, 0.49)),
)


@given(noise=NOISES, seed=st.integers(0, 9), blocks=st.lists(st.integers(0, 12), min_size=1, max_size=8))
def test_any_block_alone_is_the_same(noise: dict[str, Any], seed: int, blocks: list[int]) -> None:
    """In any order, by one that knows nothing: what an agent does that comes back."""
    what = lossy(noise | {"on_loss": "hold"}, run={"seed": seed})
    chain, sources, air = Losses(what), [], Air(what)
    fates = [chain.block(1, 2, number) for number in range(13)]
    for number in blocks:
        np.testing.assert_array_equal(fates[number], Losses(what).block(1, 2, number))
    heard = -1
    for k, lost in enumerate(np.concatenate(fates).tolist()):
        heard = k if k == 0 or not lost else heard
        sources.append(heard)
    for number in blocks:
        expected = sources[number * BLOCK : (number + 1) * BLOCK]
        assert air.sources(1, 2, number).tolist() == expected
        assert Air(what).sources(1, 2, number).tolist() == expected


def test_probabilities_are_stationary() -> None:
    what = lossy({"loss": {"default": 0.2, "arcs": [[1, 2, 0.0], [2, 1, 0.7]]}, "burst": 3.0})
    after_kept, after_lost = loss_probabilities(what)
    np.testing.assert_allclose(what.loss * after_lost + (1 - what.loss) * after_kept, what.loss, atol=1e-15)
    assert after_lost[0, 1] == pytest.approx(2 / 3)
    assert after_lost[1, 0] == after_kept[1, 0] == 0.0
