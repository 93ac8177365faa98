"""The channel file: what it says, and every mistake in one line."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from networks import experiment

from msg_agents.channel.channel_file import BASE, Channel, ChannelSpec, PairSpec, TwoStates, json_schema
from msg_analysis.errors import InputError
from msg_analysis.experiment.problems import ExperimentError

ROOT = Path(__file__).parents[3]
TWO = {"left": {"agents": [1, 2]}, "right": {"agents": ["3-5"]}}


def parse(**document: Any) -> Channel:
    return Channel.parse(document, experiment())


def problems(**document: Any) -> list[str]:
    with pytest.raises(ExperimentError) as caught:
        parse(**document)
    return caught.value.problems


def test_by_default_every_process_is_a_host_and_nothing_is_lost() -> None:
    """One of several agents, too."""
    channel = parse()
    assert channel.hosts == {BASE: (), **{f"agent_{i + 1}": (i,) for i in range(5)}}
    assert len(channel.links) == 6 * 5
    assert {link.loss.mean for link in channel.links.values()} == {0.0}
    assert {(link.delay, link.jitter, link.rate) for link in channel.links.values()} == {(0.0, 0.0, float("inf"))}
    assert not channel.agent_loss(5).any()
    channel = Channel.parse({}, experiment(run={"processes": 2}))
    assert channel.hosts == {BASE: (), "agents_1_to_2": (0, 1), "agents_3_to_5": (2, 3, 4)}
    assert [channel.host_of(agents) for agents in ((0, 1), (2, 3, 4), ())] == ["agents_1_to_2", "agents_3_to_5", BASE]


def test_pairs_take_from_the_default_what_they_do_not_say() -> None:
    channel = parse(
        seed=4,
        hosts=TWO,
        default={"loss": 0.2, "delay_ms": 5, "jitter_ms": 1},
        pairs=[{"sender": "left", "receiver": "right", "loss": 0.5}, {"between": [BASE, "left"], "rate_mbit": 2}],
        mtu=1500,
    )
    assert (channel.seed, channel.mtu, channel.graph) == (4, 1500, False)
    one, back = channel.links["left", "right"], channel.links["right", "left"]
    assert (one.loss.mean, one.delay, one.jitter) == (0.5, 0.005, 0.001)
    assert (back.loss.mean, back.delay, back.jitter) == (0.2, 0.005, 0.001)
    assert channel.links[BASE, "left"].rate == channel.links["left", BASE].rate == 2
    assert channel.links[BASE, "right"].rate == float("inf")
    wanted = np.zeros((5, 5))
    wanted[2:, :2], wanted[:2, 2:] = 0.5, 0.2  # row: who hears
    np.testing.assert_array_equal(channel.agent_loss(5), wanted)


def test_a_clean_path_for_the_recorder() -> None:
    channel = parse(hosts=TWO, default={"loss": 0.2}, recorder="clean")
    assert {link.loss.mean for pair, link in channel.links.items() if BASE in pair} == {0.0}
    assert channel.links["left", "right"].loss.mean == 0.2


def test_bursts_and_states() -> None:
    channel = parse(hosts=TWO, default={"loss": 0.2, "burst": 4})
    loss = channel.links["left", "right"].loss
    assert (loss.good, loss.bad, loss.to_good, loss.mean) == (0, 1, 0.25, pytest.approx(0.2))
    channel = parse(hosts=TWO, default={"loss": {"bad": 0.6, "to_bad": 0.1, "to_good": 0.3}})
    assert channel.links["left", "right"].loss.mean == pytest.approx(0.25 * 0.6)


STATES = {"bad": 0.6, "to_bad": 0.1, "to_good": 0.3}


@pytest.mark.parametrize(
    ("default", "pair", "wanted"),  # good, bad, to_bad, to_good of the pair
    [
        ({"loss": 0.2, "burst": 4}, {"loss": 0.5}, (0, 1, 0.25, 0.25)),
        ({"loss": 0.2, "burst": 4}, {"burst": 5}, (0, 1, 0.05, 0.2)),
        ({"loss": 0.2}, {"burst": 5}, (0, 1, 0.05, 0.2)),
        ({"loss": 0.2, "burst": 4}, {"loss": 0.5, "burst": 1}, (0, 1, 1, 1)),
        ({"loss": 0.2, "burst": 4}, {"loss": STATES}, (0, 0.6, 0.1, 0.3)),
        ({"loss": STATES}, {"loss": 0.5}, (0.5, 0.5, 0, 1)),
        ({"loss": STATES}, {"delay_ms": 1}, (0, 0.6, 0.1, 0.3)),
    ],
)
def test_a_pair_keeps_the_losses_of_the_default(default: Any, pair: Any, wanted: tuple[float, ...]) -> None:
    """By hand: bursts of b packets with loss p end with 1 / b and begin with p / (b (1 - p))."""
    channel = parse(hosts=TWO, default=default, pairs=[{"between": ["left", "right"], **pair}])
    loss = channel.links["left", "right"].loss
    assert (loss.good, loss.bad, loss.to_bad, loss.to_good) == pytest.approx(wanted)


def test_links_of_the_graphs_join_hosts() -> None:
    """Hosts {1, 2} and {3, 4, 5}: the line joins them by 2 - 3, the other graph by 5 - 1, in one direction only."""
    used = np.zeros((3, 5, 5), dtype=bool)
    used[0, 1, 2] = used[0, 2, 1] = used[0, 0, 1] = True
    used[1, 0, 4] = True  # the other way, acknowledgements must pass
    used[2, 3, 4] = True
    joined = parse(hosts=TWO, graph=True).joined(used)
    assert joined[:, 1, 2].tolist() == joined[:, 2, 1].tolist() == [True, True, False]
    assert joined[:, 0, :].all()
    assert joined[:, :, 0].all()


@pytest.mark.parametrize(
    ("document", "wanted"),
    [
        ({"default": {"loss": 1}}, "default.loss: 1: expected a number >= 0 and < 1, or {good, bad, to_bad, to_good}"),
        ({"default": {"loss": 0.5, "burst": 0.5}}, "default.burst: 0.5: expected a number >= 1"),
        ({"default": {"loss": 0.9, "burst": 2}}, "default.burst: 2.0: expected at least 9"),
        (
            {"default": {"loss": STATES}, "pairs": [{"between": [BASE, "agent_1"], "burst": 2}]},
            "pairs[1].burst: 2.0: expected a number as loss",
        ),
        (
            {"default": {"loss": 0.1, "burst": 2}, "pairs": [{"between": [BASE, "agent_1"], "loss": 0.9}]},
            "pairs[1].loss: 0.9: expected at most 0.6667 with burst 2, which is that of `default`",
        ),
        (
            {"default": {"delay_ms": 3, "jitter_ms": 2}, "pairs": [{"between": [BASE, "agent_1"], "delay_ms": 1}]},
            "pairs[1].delay_ms: 1.0: expected at least 2, the jitter_ms of `default`",
        ),
        ({"default": {"delay_ms": -1}}, "default.delay_ms: -1: expected a number of milliseconds from 0 to 60000"),
        ({"default": {"delay_ms": 1, "jitter_ms": 2}}, "default.jitter_ms: 2.0: expected at most delay_ms, 1"),
        ({"default": {"rate_mbit": 0}}, "default.rate_mbit: 0: expected a number of Mbit/s > 0"),
        ({"default": {"queue": 5}}, "default.queue: 5: has no effect without rate_mbit"),
        ({"default": {"los": 0.1}}, "default.los: unknown key: expected one of loss, burst"),
        ({"seed": -1}, "seed: -1: expected a number >= 0"),
        ({"graph": "yes"}, 'graph: "yes"'),
        ({"recorder": "left"}, "recorder: \"left\": expected 'clean' or 'default'"),
        ({"hosts": {"left": {"agents": [1, 2, 3]}}}, "agents: [4, 5]: on no host"),
        ({"hosts": {"a": {"agents": ["1-5"]}, "b": {"agents": []}}}, "hosts.b.agents: []: expected at least one"),
        ({"hosts": {BASE: {"agents": ["1-5"]}}}, "hosts: base: is the host of recorder and switcher"),
        ({"pairs": [{"loss": 0.1}]}, "pairs[1]: which pair: expected sender and receiver, or between"),
        ({"pairs": [{"sender": "agent_1"}]}, "pairs[1]: which pair: expected sender and receiver, or between"),
        ({"pairs": [{"between": ["agent_1", "agent_9"]}]}, "pairs[1]: agent_9: expected one of base, agent_1"),
        ({"pairs": [{"sender": "agent_1", "receiver": "agent_1"}]}, "pairs[1]: from agent_1 to agent_1: expected two"),
        ({"pairs": [{"between": ["agent_1", BASE]}], "recorder": "clean"}, "contradicts recorder: clean"),
        ({"default": {"loss": {"to_bad": 0.1, "to_good": 0}}}, "default.loss.to_good: 0: expected a number > 0"),
        (
            {"pairs": [{"between": ["agent_1", "agent_2"]}, {"sender": "agent_2", "receiver": "agent_1"}]},
            "pairs[2]: from agent_2 to agent_1: a pair that is there already: remove one",
        ),
    ],
)
def test_mistakes(document: dict[str, Any], wanted: str) -> None:
    found = problems(**document)
    assert any(wanted in line for line in found), found


def test_all_mistakes_are_reported_together_with_the_file(tmp_path: Path) -> None:
    file = tmp_path / "channel.yaml"
    file.write_text("default: {loss: 2, delay_ms: no}\nspeed: 3\n")
    with pytest.raises(ExperimentError, match=r"channel\.yaml: 3 problems") as caught:
        Channel.load(file, experiment())
    assert len(caught.value.problems) == 3
    file.write_text("- 1\n")
    with pytest.raises(InputError, match="expected some of the keys seed, hosts, default, pairs"):
        Channel.load(file, experiment())


def test_schema_is_up_to_date() -> None:
    committed = json.loads((ROOT / "docs/channel.schema.json").read_text())
    assert committed == json_schema(), "run: msg-agents schema > docs/channel.schema.json"
    assert all("description" in field for field in committed["properties"].values())


def test_the_example_of_the_documentation() -> None:
    page = (ROOT / "docs/channel.md").read_text()
    document = yaml.safe_load(page.partition("```yaml\n")[2].partition("```")[0])
    channel = Channel.parse(document, experiment())
    assert list(channel.hosts) == [BASE, "left", "right"]
    assert (channel.links["right", "left"].loss.to_good, channel.links[BASE, "left"].rate) == (0.25, 6)
    for key in (*ChannelSpec.model_fields, *PairSpec.model_fields, *TwoStates.model_fields):
        assert re.search(rf"\b{key}\b", page), key
