"""The sweep file: which points it stands for, and what is wrong with it, before anything runs."""

import copy
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from msg_analysis.errors import InputError
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.sweeps.grid import KeyProblemError, SweepGrid, json_schema, load_sweep, own_seed, put

EXPERIMENT: dict[str, Any] = {
    "name": "two",
    "graphs": {"line": {"path": [1, 2, 3]}, "ring": {"cycle": [1, 2, 3]}},
    "switching": {"rates": {"line": {"ring": 1.0}, "ring": {"line": 1.0}}},
    "run": {"dt": 0.1, "duration": 10, "seed": 3},
}


def load(directory: Path, **sweep: Any) -> SweepGrid:
    path = directory / "try.yaml"
    path.write_text(yaml.safe_dump({"experiment": EXPERIMENT, **sweep}, sort_keys=False))
    return load_sweep(path)


def values(sweep: SweepGrid, key: str) -> list[Any]:
    return [point.values[key] for point in sweep.points]


def complaint(directory: Path, **sweep: Any) -> str:
    with pytest.raises(InputError) as error:
        load(directory, **sweep)
    return str(error.value)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ([1, 2.5], [1, 2.5]),
        ({"values": [1, 2.5]}, [1, 2.5]),
        ({"from": 1, "to": 3, "count": 3}, [1, 2, 3]),
        ({"from": 0.1, "to": 0.3, "count": 3}, [0.1, 0.2, 0.3]),
        ({"from": 0.1, "to": 0.7, "step": 0.2}, [0.1, 0.3, 0.5, 0.7]),
        ({"from": 5, "to": 1, "step": -2}, [5, 3, 1]),
        ({"from": 0.01, "to": 100, "count": 5, "spacing": "log"}, [0.01, 0.1, 1.0, 10.0, 100.0]),
        ({"from": 2, "to": 2, "count": 1}, [2]),
    ],
)
def test_ranges(tmp_path: Path, given: Any, expected: list[float]) -> None:
    assert values(load(tmp_path, over={"switching.scale": given}), "switching.scale") == expected


def test_whole_numbers_stay_whole(tmp_path: Path) -> None:
    """run.replicas must be whole: 1.0 would be refused."""
    assert values(load(tmp_path, over={"run.replicas": {"from": 1, "to": 9, "step": 4}}), "run.replicas") == [1, 5, 9]


@pytest.mark.parametrize(
    "given",
    [
        3,
        [],
        {},
        {"values": []},
        {"values": [1], "count": 2},
        {"from": 1, "to": 2},
        {"from": 1, "to": 2, "count": 3, "step": 1},
        {"from": 1, "to": 2, "count": 1},
        {"from": 1, "to": 2, "step": -1},
        {"from": 1, "to": 2, "step": 0},
        {"from": 0, "to": 2, "count": 3, "spacing": "log"},
        {"from": 1, "to": 2, "count": 3, "spacing": "cubic"},
        {"from": 1, "to": "inf", "count": 3},
        {"from": 1, "to": 2, "count": 10**9},
        {"fron": 1, "to": 2, "count": 3},
    ],
)
def test_bad_ranges_are_named(tmp_path: Path, given: Any) -> None:
    text = complaint(tmp_path, over={"switching.scale": given})
    assert "try.yaml: over.switching.scale: " in text
    assert "expected" in text


def test_lists_are_values_where_a_key_is_a_list(tmp_path: Path) -> None:
    """One noise gain per agent is one value."""
    sweep = load(tmp_path, over={"noise.process": [1.0, [1, 2, 3], {"line": 1.0, "ring": 2.0}]})
    gains = [Experiment.parse(yaml.safe_load(point.job.document)).noise_gain for point in sweep.points]
    assert [gain.shape for gain in gains] == [(2, 3, 3)] * 3
    assert np.diag(gains[1][0]).tolist() == [1, 2, 3]


def test_grid_and_zip(tmp_path: Path) -> None:
    over = {"switching.scale": [1.0, 2.0], "noise.loss": [0.0, 0.1]}
    pairs = [tuple(point.values.values()) for point in load(tmp_path, over=over).points]
    assert pairs == [(1.0, 0.0), (1.0, 0.1), (2.0, 0.0), (2.0, 0.1)]
    pairs = [tuple(point.values.values()) for point in load(tmp_path, over=over, combine="zip").points]
    assert pairs == [(1.0, 0.0), (2.0, 0.1)]
    over["noise.loss"] = [0.0]
    assert "switching.scale: 2, noise.loss: 1" in complaint(tmp_path, over=over, combine="zip")


def test_an_experiment_file_is_relative_to_the_sweep_file(tmp_path: Path) -> None:
    (tmp_path / "below").mkdir()
    (tmp_path / "below/two.yaml").write_text(yaml.safe_dump(EXPERIMENT))
    sweep = load(tmp_path, experiment="below/two.yaml", over={"run.dt": [0.1, 0.2]})
    assert sweep.experiment == "two"
    assert sweep.name == "try"
    assert "absent.yaml: no such file" in complaint(tmp_path, experiment="absent.yaml", over={"run.dt": [0.1]})


def test_graphml_is_read_here_so_that_workers_need_no_file(tmp_path: Path) -> None:
    import networkx as nx

    nx.write_graphml(nx.cycle_graph(range(1, 4)), tmp_path / "ring.graphml")
    graphs = {"line": {"path": [1, 2, 3]}, "ring": {"graphml": "ring.graphml"}}
    (point,) = load(tmp_path, experiment=EXPERIMENT | {"graphs": graphs}, over={"run.dt": [0.1]}).points
    assert "graphml" not in point.job.document
    assert Experiment.parse(yaml.safe_load(point.job.document)).graph_list[1].adjacency.sum() == 6


@pytest.mark.parametrize(
    ("over", "words"),
    [
        (
            {"switching.scale": [1.0, -1.0], "noise.loss": [0.0, 0.5]},
            "point 3 (switching.scale = -1.0, noise.loss = 0.0); point 4 (switching.scale = -1.0, noise.loss = 0.5): "
            "switching.scale: -1.0: expected a number > 0",
        ),
        (
            {"switching.scael": [1.0, 2.0]},
            "every point: switching.scael: unknown key: expected one of generator, rates",
        ),
        ({"run.dt": [0.1, 0.9]}, "point 2 (run.dt = 0.9): run.dt: 0.9: expected less than"),
        ({"name.x": [1]}, 'over.name.x: name is "two": expected keys with values there'),
        ({"run.dt[2]": [1]}, "over.run.dt[2]: run.dt has 0.1: expected a list with at least 2 entries"),
        ({"noise.process[1]": [1]}, "over.noise.process[1]:"),
        ({"a..b": [1]}, "over.a..b: not a key"),
        ({"graphs.line.path[0]": [1]}, "places from 1"),
    ],
)
def test_every_point_is_checked_before_anything_runs(tmp_path: Path, over: Any, words: str) -> None:
    assert words in complaint(tmp_path, over=over)


def test_what_this_version_cannot_do_is_refused(tmp_path: Path) -> None:
    what = EXPERIMENT | {"protocol": {"name": "saturated"}, "run": EXPERIMENT["run"] | {"start": "zero"}}
    over = {"noise.delay": [0, 1]}
    assert len(load(tmp_path, experiment=what, over=over, kind="simulate").points) == 2
    text = complaint(tmp_path, experiment=what, over=over, kind="predict")
    assert 'every point: protocol.name: "saturated": expected a linear protocol' in text


@pytest.mark.parametrize(
    ("sweep", "words"),
    [
        ({}, "over: missing"),
        ({"over": {}}, "over:"),
        ({"over": {"run.dt": [0.1]}, "kind": "predikt"}, "did you mean 'predict'?"),
        ({"over": {"run.dt": [0.1]}, "kynd": "predict"}, "kynd: unknown key"),
        ({"over": {"run.dt": [0.1]}, "repetitions": 2}, "a prediction does not depend on chance"),
        ({"over": {"run.dt": [0.1]}, "until": "5%"}, "until: 5%: expected none: only a network can end early"),
        ({"over": {"run.dt": [0.1]}, "kind": "network", "until": "decided"}, "expected a precision such as 5%"),
        ({"over": {"run.dt": [0.1]}, "kind": "network", "until": "soon"}, "expected a precision such as 5%"),
        ({"over": {"run.seed": [1, 2]}, "repetitions": 2, "kind": "simulate"}, "since run.seed is swept"),
        ({"over": {"run.seed": {"from": 1, "to": 15000, "step": 1}, "run.dt": [0.1, 0.2]}}, "30000 points"),
        ({"over": {"run.dt": [0.1]}, "experiment": 3}, "the name of a file, or the keys of an experiment"),
        ({"over": {"run.dt": [0.1]}, "level": 0.7}, "level: 0.7"),
    ],
)
def test_mistakes_in_the_file(tmp_path: Path, sweep: Any, words: str) -> None:
    assert words in complaint(tmp_path, **sweep)


def test_seeds_are_of_the_point_and_stay_when_others_come(tmp_path: Path) -> None:
    def seeds(scales: list[float], **options: Any) -> dict[tuple[float, int | None], int | None]:
        sweep = load(tmp_path, over={"switching.scale": scales}, kind="simulate", **options)
        return {(point.values["switching.scale"], point.repetition): point.seed for point in sweep.points}

    few, more = seeds([1.0, 2.0], repetitions=2), seeds([0.5, 1.0, 2.0], repetitions=3)
    assert len(set(more.values())) == 9
    assert few == {key: more[key] for key in few}
    assert seeds([1.0, 2.0], repetitions=2, seeds="common") == {(1.0, 0): 3, (1.0, 1): 4, (2.0, 0): 3, (2.0, 1): 4}
    assert own_seed(3, {"switching.scale": 1.0}, 0) == few[1.0, 0]


def test_equal_jobs_have_equal_ids_and_others_do_not(tmp_path: Path) -> None:
    def ids(**sweep: Any) -> list[str]:
        return [point.job.id for point in load(tmp_path, **sweep).points]

    over = {"switching.scale": [1.0, 2.0]}
    assert ids(over=over) == ids(over=over)
    assert set(ids(over=over)).isdisjoint(ids(over=over, kind="simulate"))
    assert set(ids(over=over, kind="simulate")).isdisjoint(ids(over=over, kind="simulate", level=0.05))
    reversed_graphs = dict(reversed(EXPERIMENT["graphs"].items()))
    path = tmp_path / "try.yaml"
    path.write_text(
        yaml.safe_dump({"experiment": EXPERIMENT | {"graphs": reversed_graphs}, "over": over}, sort_keys=False)
    )
    others = {point.job.id for point in load_sweep(path).points}
    assert len(others) == 2
    assert others.isdisjoint(ids(over=over))


def test_the_schema_in_the_documentation_is_that_of_this_version() -> None:
    assert json.loads((Path(__file__).parents[3] / "docs/sweep.schema.json").read_text()) == json_schema()


def test_one_place_is_changed_in_a_copy() -> None:
    """Also below names with dots, in lists of lists, and where nothing has been."""
    document = {"graphs": {"v1.2": {"edges": [[1, 2], [2, 3]]}, "b": {"path": [1, 2]}}}
    before = copy.deepcopy(document)
    changed = put(document, "graphs.v1.2.edges[2][1]", 1)
    assert changed == {"graphs": {"v1.2": {"edges": [[1, 2], [1, 3]]}, "b": {"path": [1, 2]}}}
    assert document == before
    assert put({}, "noise.loss", 0.5) == {"noise": {"loss": 0.5}}
    with pytest.raises(KeyProblemError, match="expected a list"):
        put({"a": {}}, "a.b[1]", 1)


def test_until_is_part_of_a_job(tmp_path: Path) -> None:
    """What was run to its duration is not the result of a run that may end early, nor of one with another precision."""
    jobs = [
        load(tmp_path, over={"run.dt": [0.1]}, kind="network", **changes).points[0].job
        for changes in ({}, {"until": "5%"}, {"until": "5.0 %"}, {"until": "1%"})
    ]
    assert [job.until for job in jobs] == [None, "5%", "5%", "1%"]
    assert jobs[1].id == jobs[2].id
    assert len({job.id for job in jobs}) == 3
