"""The same file and seed give the same run on any processor; what one wrote, another checks."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from processors import another_processor

import experiments
from experiments import Experiment, RunRecord, new_record, read_bag, simulate, write_trajectory
from msg_analysis.errors import InputError

PATH_AND_STAR = {"path": {"path": [1, 2, 3, 4, 5, 6]}, "star": {"star": {"center": 2}}}
SWITCHING = {"generator": [[-1, 1], [2, -2]]}
CORRELATED = [[1.0 if i == j else 0.3 / (1 + i + 2 * j) for j in range(6)] for i in range(6)]
DISCRETE = {
    "time": "discrete",
    "switching": {"transition": [[0.9, 0.1], [0.4, 0.6]]},
    "run": {"dt": 1, "duration": 300},
}
CASES: dict[str, dict[str, Any]] = {
    "consensus": {"noise": {"process": CORRELATED}},
    "tracking": {"problem": "tracking", "leaders": {"agents": [3], "gain": 1.0, "reference": 2.0}},
    "grounded": {"problem": "tracking", "leaders": {"agents": [3], "gain": "inf", "reference": 2.0}},
    "too large for a past": {
        "problem": "tracking",
        "leaders": {"agents": [3], "gain": "inf", "reference": 2.0},
        "noise": {"process": CORRELATED},
        "run": {"replicas": 11_000, "duration": 0.05},
    },
    "on air": {"noise": {"process": 1.0, "broadcast": 0.3, "link": 0.2, "loss": 0.1}},
    "real time": {"run": {"pace": "realtime"}},
    "discrete": DISCRETE,
    "discrete tracking": {"problem": "tracking", "leaders": {"agents": [3], "gain": 2.0, "reference": 1.0}, **DISCRETE},
    "a protocol": {"protocol": {"name": "metropolis"}, **DISCRETE},
}
WRITE = """
import sys
from pathlib import Path
from experiments import Experiment, simulate, write_trajectory
for file in map(Path, sys.argv[1:]):
    write_trajectory(simulate(Experiment.load(file)), file.with_suffix(""))
"""


def document(case: str) -> dict[str, Any]:
    changes = CASES[case]
    run = {"duration": 15, "seed": 7} | changes.get("run", {})
    return experiments.document(**{"graphs": PATH_AND_STAR, "switching": SWITCHING} | changes | {"run": run})


def test_a_run_is_the_same_on_another_processor(tmp_path: Path) -> None:
    other, files = another_processor(), [tmp_path / f"{case.replace(' ', '_')}.yaml" for case in CASES]
    for file, case in zip(files, CASES, strict=True):
        file.write_text(yaml.safe_dump(document(case)))
    environment = os.environ | other | {"PYTHONPATH": os.pathsep.join(sys.path)}
    subprocess.run([sys.executable, "-c", WRITE, *files], env=environment, check=True)
    for file in files:
        theirs, ours = read_bag(file.with_suffix("")), simulate(Experiment.load(file))
        assert np.array_equal(theirs.states, ours.states), file.stem
        assert np.array_equal(theirs.modes, ours.modes), file.stem
        again = simulate(theirs.record.experiment, record=theirs.record)
        assert np.array_equal(again.states, theirs.states), file.stem


@pytest.mark.parametrize("case", ["grounded", "too large for a past"])
def test_a_grounded_leader_starts_on_the_reference(case: str) -> None:
    """So many states have no past, whatever their number of steps: theirs are drawn, and rounded to a grid."""
    start = new_record(Experiment.parse(document(case))).start
    assert (start[2] == 2.0).all()
    assert len(np.unique(start[:, :2])) == 1 + 5 * 2
    scaled = start * 2.0**20
    assert (scaled == np.rint(scaled)).all() == (case == "too large for a past")


@pytest.mark.parametrize("case", ["discrete", "discrete tracking", "a protocol"])
def test_the_record_carries_the_matrices(case: str, tmp_path: Path) -> None:
    record = new_record(Experiment.parse(document(case)))
    write_trajectory(simulate(record.experiment, record=record), tmp_path / "bag")
    again = read_bag(tmp_path / "bag").record
    assert np.array_equal(again.matrices.weights, record.matrices.weights)
    assert np.array_equal(again.matrices.noise_gain, record.matrices.noise_gain)
    assert np.array_equal(again.step_model.nominal, record.step_model.nominal)
    weights = np.zeros_like(record.matrices.weights[0])
    for i, j, value in json.loads(record.to_json())["step"]["weights"][0]:
        weights[i - 1, j - 1] = value
    assert np.array_equal(weights, record.matrices.weights[0])


def test_what_follows_from_the_experiment_is_not_in_the_record() -> None:
    """So a record that is changed by hand, as in the tutorial, is a run of the changed experiment."""
    record = new_record(Experiment.parse(document("consensus")))
    assert "step" not in json.loads(record.to_json())
    louder = json.loads(record.to_json())
    louder["experiment"]["noise"]["process"] = 2.0
    again = RunRecord.from_json(json.dumps(louder), "here")
    assert again.step_model.noise_gain[0, 0, 0] == 2.0 * np.sqrt(0.05)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"weights": [[[1, 2, 0.5]]]}, "step.weights has 1 graphs, expected 2"),
        ({"weights": [[], [], [[1, 2, 0.5]]]}, "step.weights has 3 graphs, expected 2"),
        ({"weights": [[[1, 7, 0.5]], []]}, "graph 1: expected entries"),
        ({"weights": [[], [[0, 1, 0.5]]]}, "graph 2: expected entries"),
        ({"weights": [[[1, 2, float("nan")]], []]}, "graph 1: expected entries"),
        ({"weights": [[[1, 2]], []]}, "not a run record"),
        ({}, "not a run record"),
    ],
)
def test_wrong_matrices(change: dict[str, Any], complaint: str) -> None:
    text = json.loads(new_record(Experiment.parse(document("discrete"))).to_json()) | {"step": change}
    with pytest.raises(InputError, match=complaint):
        RunRecord.from_json(json.dumps(text), "here")
