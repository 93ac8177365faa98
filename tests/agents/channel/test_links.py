"""Loss, delay, rate and queue of one direction between two hosts."""

import math
from itertools import groupby

import numpy as np
import pytest
from scipy import stats

from msg_agents.channel.links import Link, LinkSettings, LossModel
from msg_agents.channel.links import PacketOutcome as Outcome

PACKETS = 100_000
LEVEL = 1e-6  # false-alarm rate of each statistical test; the seeds are fixed, so it does not change from run to run


def losses(settings: LinkSettings, seed: int = 1, packets: int = PACKETS, pair: tuple[int, int] = (2, 3)) -> np.ndarray:
    """Whether each packet is lost."""
    link = Link(settings, seed, *pair)
    return np.array([link.carry(100, 0.0)[0] is Outcome.LOST for _ in range(packets)])


def loss(probability: float) -> LinkSettings:
    return LinkSettings(LossModel(probability, probability, 0.0, 1.0))


def test_losses_are_the_numbers_of_the_philox_streams() -> None:
    """By numpy alone: key from the seed, counter 0, block, receiver << 32 | sender, 100; the first of three rows."""
    key = np.random.SeedSequence(11).generate_state(2, np.uint64)
    wanted = []
    for block in range(3):
        bits = np.random.Philox(key=key, counter=np.array([0, block, 7 << 32 | 5, 100], dtype=np.uint64))
        wanted += list(np.random.Generator(bits).random((3, 256))[0] < 0.3)
    assert losses(loss(0.3), seed=11, packets=768, pair=(5, 7)).tolist() == wanted


def test_losses_are_independent_of_times_and_sizes() -> None:
    link = Link(LinkSettings(loss(0.3).loss, delay=0.02, jitter=0.01), 1, 2, 3)
    lost = [link.carry(50 + number % 1000, number * 0.37)[0] is Outcome.LOST for number in range(1000)]
    assert lost == losses(loss(0.3), packets=1000).tolist()


def test_packets_that_are_skipped_have_numbers_of_their_own() -> None:
    link = Link(loss(0.3), 1, 2, 3)
    wanted = losses(loss(0.3), packets=600).tolist()
    found = []
    for _ in range(200):
        found.append(link.carry(1, 0.0)[0] is Outcome.LOST)
        link.skip()
        link.skip()
    assert found == wanted[::3]


@pytest.mark.parametrize("other", [{"seed": 2}, {"pair": (3, 2)}, {"pair": (2, 4)}])
def test_seeds_and_pairs_differ(other: dict[str, object]) -> None:
    first, second = losses(loss(0.5), packets=5000), losses(loss(0.5), packets=5000, **other)
    assert stats.binomtest(int((first == second).sum()), 5000, 0.5).pvalue > LEVEL


def test_independent_losses() -> None:
    lost = losses(loss(0.2))
    assert stats.binomtest(int(lost.sum()), PACKETS, 0.2).pvalue > LEVEL
    after_loss = lost[1:][lost[:-1]]
    assert stats.binomtest(int(after_loss.sum()), len(after_loss), 0.2).pvalue > LEVEL


def test_bursts_have_a_geometric_length() -> None:
    """Length n with probability (1 - 1/5)^(n - 1) / 5; the gaps between them are geometric, too."""
    model = LossModel.bursts(0.2, 5)
    assert model.mean == pytest.approx(0.2)
    lost = losses(LinkSettings(model))
    runs = [(state, len(list(group))) for state, group in groupby(lost)][1:-1]
    for state, mean in ((True, 5.0), (False, 5.0 * 0.8 / 0.2)):
        lengths = np.array([length for found, length in runs if found == state])
        edges = np.arange(1, 12)
        seen = [int((lengths == n).sum()) for n in edges] + [int((lengths > edges[-1]).sum())]
        law = stats.geom(1 / mean)
        wanted = np.array([*law.pmf(edges), law.sf(edges[-1])]) * len(lengths)
        assert stats.chisquare(seen, wanted).pvalue > LEVEL


def test_two_states() -> None:
    """The share of losses is that of the stationary law of the two states; neighbours are correlated as it says."""
    # With u the deviation from the mean, E[u(k) u(k + 1)] = pi_good pi_bad (bad - good)^2 (1 - to_bad - to_good).
    good, bad, to_bad, to_good = 0.05, 0.7, 0.02, 0.1
    chain = np.array([[1 - to_bad, to_bad], [to_good, 1 - to_good]])
    values, vectors = np.linalg.eig(chain.T)
    stationary = np.real(vectors[:, np.argmin(abs(values - 1))])
    stationary /= stationary.sum()
    model = LossModel(good, bad, to_bad, to_good)
    assert model.mean == pytest.approx(stationary @ [good, bad])
    lost = losses(LinkSettings(model)).astype(float)
    covariance = stationary.prod() * (bad - good) ** 2 * (1 - to_bad - to_good)
    blocks = lost.reshape(100, -1)  # of 1000 packets: nearly independent, so the mean of their values has a t law
    assert stats.ttest_1samp(blocks.mean(axis=1), model.mean).pvalue > LEVEL
    deviations = blocks - model.mean
    assert stats.ttest_1samp((deviations[:, 1:] * deviations[:, :-1]).mean(axis=1), covariance).pvalue > LEVEL


def test_delay_is_uniform_and_keeps_the_order() -> None:
    link = Link(LinkSettings(delay=0.02, jitter=0.005), 1, 2, 3)
    arrivals = [link.carry(100, number * 1.0)[1] - number for number in range(20_000)]  # far apart: no order to keep
    assert stats.kstest(arrivals, stats.uniform(0.015, 0.01).cdf).pvalue > LEVEL
    link = Link(LinkSettings(delay=0.02, jitter=0.02), 1, 2, 3)
    close = [link.carry(100, number * 1e-4)[1] for number in range(2000)]
    assert close == sorted(close)
    assert all(arrival >= number * 1e-4 for number, arrival in enumerate(close))


def test_rate_and_queue_by_hand() -> None:
    """125 bytes take 1 ms at 1 Mbit/s: one is sent, two wait, the fourth is dropped; at 1.5 ms one more can wait."""
    link = Link(LinkSettings(delay=0.01, rate=1.0, queue=2), 1, 2, 3)
    found = [link.carry(125, 0.0) for _ in range(4)] + [link.carry(125, 0.0015) for _ in range(2)]
    last = [Outcome.DROPPED, Outcome.PASSED, Outcome.DROPPED]
    assert [outcome for outcome, _ in found] == [Outcome.PASSED] * 3 + last
    times = [time for outcome, time in found if outcome is Outcome.PASSED]
    assert times == pytest.approx([0.011, 0.012, 0.013, 0.014])
    assert link.waited == 3
    assert link.carry(250, 1.0) == (Outcome.PASSED, pytest.approx(1.012))


def test_without_a_queue_only_one_packet_is_on_its_way() -> None:
    link = Link(LinkSettings(rate=1.0, queue=0), 1, 2, 3)
    outcomes = [Outcome.PASSED, Outcome.DROPPED, Outcome.PASSED]
    assert [link.carry(125, time)[0] for time in (0.0, 0.0005, 0.0011)] == outcomes


def test_lost_packets_take_their_time_on_the_air() -> None:
    certain = LossModel(1.0, 1.0, 0.0, 1.0)
    link = Link(LinkSettings(certain, rate=1.0, queue=0), 1, 2, 3)
    assert [link.carry(125, time)[0] for time in (0.0, 0.0005)] == [Outcome.LOST, Outcome.DROPPED]


@pytest.mark.parametrize(
    "model",
    [LossModel(0.3, 0.3, 0.0, 1.0), LossModel.bursts(0.2, 4.0), LossModel(0.05, 0.7, 0.02, 0.1)],
    ids=["independent", "bursts", "two states"],
)
def test_the_variance_of_the_number_of_losses(model: LossModel) -> None:
    """Against 400 links of 2,000 packets; a chi-square law within 5 standard errors: false alarms below 1e-6 each."""
    numbers = [losses(LinkSettings(model), seed, 2_000).sum() for seed in range(400)]
    expected = 2_000 * model.mean * (1.0 - model.mean) * model.inflation
    assert abs(np.var(numbers, ddof=1) / expected - 1.0) < 5 * math.sqrt(2 / 399)
