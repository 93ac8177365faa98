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
from msg_analysis.twin import simulate as twin_start

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


def document(changes: dict[str, Any]) -> dict[str, Any]:
    run = {"duration": 15, "seed": 7} | changes.get("run", {})
    return experiments.document(**{"graphs": PATH_AND_STAR, "switching": SWITCHING} | changes | {"run": run})


def test_a_run_is_the_same_on_another_processor(tmp_path: Path) -> None:
    other, files = another_processor(), []
    for name, changes in CASES.items():
        files.append(tmp_path / f"{name.replace(' ', '_')}.yaml")
        files[-1].write_text(yaml.safe_dump(document(changes)))
    environment = os.environ | other | {"PYTHONPATH": os.pathsep.join(sys.path)}
    subprocess.run([sys.executable, "-c", WRITE, *files], env=environment, check=True)
    for file in files:
        theirs, ours = read_bag(file.with_suffix("")), simulate(Experiment.load(file))
        assert np.array_equal(theirs.states, ours.states), file.stem
        assert np.array_equal(theirs.modes, ours.modes), file.stem
        again = simulate(theirs.record.experiment, record=theirs.record)
        assert np.array_equal(again.states, theirs.states), file.stem


def test_a_long_past_is_replaced_by_a_rounded_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On another processor too: the rounding is far above what linear algebra differs by."""
    other, file = another_processor(), tmp_path / "net.yaml"
    file.write_text(yaml.safe_dump(document(CASES["grounded"] | {"noise": {"process": CORRELATED}})))
    code = "from msg_analysis.twin import simulate as twin_start; twin_start.MAX_PAST = 0\n" + WRITE
    environment = os.environ | other | {"PYTHONPATH": os.pathsep.join(sys.path)}
    subprocess.run([sys.executable, "-c", code, file], env=environment, check=True)
    monkeypatch.setattr(twin_start, "MAX_PAST", 0)
    start = new_record(Experiment.load(file)).start
    assert np.array_equal(read_bag(file.with_suffix("")).record.start, start)
    assert (start[2] == 2.0).all()  # the grounded leader
    assert len(np.unique(start)) == 1 + 5 * 2


@pytest.mark.parametrize("case", ["discrete", "discrete tracking", "a protocol"])
def test_the_record_carries_the_matrices(case: str, tmp_path: Path) -> None:
    record = new_record(Experiment.parse(document(CASES[case])))
    write_trajectory(simulate(record.experiment, record=record), tmp_path / "bag")
    again = read_bag(tmp_path / "bag").record
    assert np.array_equal(again.matrices.weights, record.matrices.weights)
    assert np.array_equal(again.matrices.noise_gain, record.matrices.noise_gain)
    assert np.array_equal(again.step_model.nominal, record.step_model.nominal)
    entries = json.loads(record.to_json())["step"]["weights"][0]
    assert {(i - 1, j - 1): value for i, j, value in entries} == {
        (int(i), int(j)): record.matrices.weights[0, i, j] for i, j in np.argwhere(record.matrices.weights[0])
    }


def test_what_follows_from_the_experiment_is_not_in_the_record() -> None:
    """So a record that is changed by hand, as in the tutorial, is a run of the changed experiment."""
    record = new_record(Experiment.parse(document(CASES["consensus"])))
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
    text = json.loads(new_record(Experiment.parse(document(CASES["discrete"]))).to_json()) | {"step": change}
    with pytest.raises(InputError, match=complaint):
        RunRecord.from_json(json.dumps(text), "here")


def test_a_grounded_leader_starts_on_the_reference() -> None:
    record = new_record(Experiment.parse(document(CASES["grounded"])))
    assert (record.start[2] == 2.0).all()
    assert len(np.unique(record.start)) == 1 + 5 * 2
