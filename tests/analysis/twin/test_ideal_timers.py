"""The twin in real time against the agents' own law, called one after the other."""

import numpy as np
import pytest

from msg_analysis.arithmetic.update_law import from_payload, to_payload
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.model.agent_law import agent_law
from msg_analysis.model.phases import phases
from msg_analysis.model.step_model import build_step_model
from msg_analysis.report.documents import describe_transient
from msg_analysis.theory.prediction import predict
from msg_analysis.twin.simulate import simulate

CORRELATED = [[1.0, 0.3, 0.0], [0.3, 0.8, 0.0], [0.0, 0.5, 0.9]]
CASES = {
    "consensus": {},
    "correlated": {"noise": {"process": {"a": 1.0, "b": CORRELATED}}},
    "tracking": {"problem": "tracking", "leaders": {"agents": [2], "gain": 0.7, "reference": 2.5}},
}


def experiment(run=None, **changes):
    document = {
        "name": "timers",
        "graphs": {"a": {"path": [1, 2, 3]}, "b": {"arcs": [[3, 1, 2.0], [1, 2], [2, 3]]}},
        "switching": {"generator": [[-2.0, 2.0], [3.0, -3.0]]},
        "run": {"dt": 0.1, "duration": 60, "replicas": 3, "seed": 8, "pace": "realtime"} | (run or {}),
    }
    return Experiment.parse(document | changes)


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("seed", [8, 9, 10])
def test_agents_one_after_the_other_to_the_last_bit(case, seed):
    what = experiment(run={"seed": seed}, **CASES[case])
    trajectory, model = simulate(what), build_step_model(what)
    laws = [agent_law(trajectory.record, model, i) for i in range(3)]
    newest = [to_payload(state) for state in trajectory.record.start]
    step_of = [0, 0, 0]
    order = np.argsort(phases(what)).tolist()
    for k, mode in enumerate(trajectory.modes.tolist()):
        for i in order:
            neighbours = laws[i].neighbours(mode)
            used = trajectory.used[k, i].tolist()
            assert used == [step_of[j] for j in neighbours] + [-1] * (len(used) - len(neighbours))
            newest[i] = laws[i].advance(mode, [newest[j] for j in neighbours])
            step_of[i] = k + 1
            np.testing.assert_array_equal(from_payload(newest[i]), trajectory.states[k + 1, i])
            assert trajectory.made[k + 1, i] == pytest.approx((k + phases(what)[i]) * 1e8, abs=1)
    assert (trajectory.agent_modes[1:] == trajectory.modes[:, None]).all()
    assert (trajectory.made[0] == 0).all()
    assert trajectory.completeness.complete


def test_phases_are_spread_over_the_period():
    found = {tuple(phases(experiment(run={"seed": seed}))) for seed in range(40)}
    assert len(found) == 6  # all orders of three agents
    assert {tuple(sorted(phase)) for phase in found} == {(0.5 / 3, 1.5 / 3, 2.5 / 3)}


def test_transients_are_those_of_the_sequential_law():
    what = experiment(run={"start": "zero"})
    document = describe_transient(what, np.array([0.0, 1.0, 400.0]))
    assert document["steady_system_error"] == pytest.approx(predict(what).emulated.system_error)
    assert document["system_error"][2] == pytest.approx(predict(what).emulated.system_error)
