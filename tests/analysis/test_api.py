"""What can be imported from msg_analysis itself."""

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import msg_analysis
from experiments import GOLDEN, golden
from msg_analysis import BagError, Experiment, ExperimentError, InputError, Log, Run, compare, read_bag, write_report

NUMBERS = json.loads((GOLDEN / "line_ring.predict.json").read_text())
LINE_RING = golden("line_ring", duration=50, seed=3)


@pytest.fixture(scope="module")
def twin() -> Run:
    return LINE_RING.simulate()


def test_importing_the_package_imports_nothing_else() -> None:
    code = (
        "import sys, msg_analysis\nassert 'numpy' not in sys.modules\n"
        "assert set(msg_analysis.__all__) <= set(dir(msg_analysis))\n"
        "from msg_analysis import Experiment\nassert 'numpy' in sys.modules\n"
        "assert 'matplotlib' not in sys.modules and 'rich' not in sys.modules\n"
    )
    process = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True)
    assert process.returncode == 0, process.stderr


def test_names() -> None:
    """What is promised is there, for type checkers too, and nothing else is."""
    text = Path(msg_analysis.__file__).read_text(encoding="utf-8")
    imported = re.findall(r"from msg_analysis\.[\w.]+ import (.+)", text)
    names = sorted(name for line in imported for name in line.split(", ") if "__version__" not in name)
    assert names == sorted(msg_analysis.__all__)
    for name in msg_analysis.__all__:
        assert getattr(msg_analysis, name).__name__ == name
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        getattr(msg_analysis, "nonsense")  # noqa: B009


def test_one_class_for_each_concept(twin: Run) -> None:
    """Whoever made it: what every function gives is of the class that the package exports."""
    prediction, comparison, spectrum = LINE_RING.predict(), twin.compare(), LINE_RING.spectrum([0, 1], [0.1])
    made = {
        Experiment: (LINE_RING.with_run(seed=4), twin.experiment, twin.record.experiment, prediction.experiment),
        Run: (twin, comparison.trajectory),
        msg_analysis.Prediction: (prediction, spectrum.prediction),
        msg_analysis.Comparison: (comparison, compare(twin, LINE_RING.simulate(seed=4))),
        msg_analysis.Spectrum: (spectrum,),
    }
    for kind, objects in made.items():
        assert {type(each) for each in objects} == {kind}


def test_theory() -> None:
    """The golden numbers, as arrays, in units of time; with a stationary start the error stays."""
    prediction = LINE_RING.predict()
    assert prediction.emulated.covariance.shape == (5, 5)
    for law in ("emulated", "continuous"):
        moments, course = getattr(prediction, law), LINE_RING.transient([0, 1, 2.5], law=law)
        for key in ("system_error", "system_certainty", "node_errors", "node_certainty"):
            np.testing.assert_allclose(getattr(moments, key), NUMBERS[law][key], rtol=1e-8)
        np.testing.assert_allclose(course.times, [0, 1, 2.5])
        np.testing.assert_allclose(course.system_error, NUMBERS[law]["system_error"], rtol=1e-6)
        assert course.node_errors.shape == (3, 5)
    selection = LINE_RING.leaders(1)
    assert selection.sets[0] == (selection.bound, (3,))  # the middle of the line


def test_simulate(twin: Run) -> None:
    assert (twin.states.shape, twin.times.shape, twin.times[-1]) == ((1001, 5, 16), (1001,), pytest.approx(50))
    again = golden("line_ring").simulate(seed=3, duration=50)
    assert np.array_equal(again.states, twin.states)
    assert again.record.run != twin.record.run
    assert twin.experiment == LINE_RING == Experiment.parse(LINE_RING.to_document())
    assert LINE_RING.simulate(record=twin.record).record is twin.record
    with pytest.raises(ExperimentError, match=r"run\.seed: -1"):
        LINE_RING.simulate(seed=-1)


def test_a_bag_is_the_same_run(twin: Run, tmp_path: Path) -> None:
    assert twin.save(tmp_path / "bag") == tmp_path / "bag"
    read = read_bag(tmp_path / "bag")
    assert (type(read), read.completeness.complete) == (Run, True)
    assert np.array_equal(read.states, twin.states)
    with pytest.raises(BagError, match="exists already"):
        twin.save(tmp_path / "bag")
    with pytest.raises(BagError, match="not found"):
        read_bag(tmp_path / "nowhere")


def test_compare(twin: Run, tmp_path: Path) -> None:
    """Runs and bags, one or several. The seeds are fixed; fresh ones would disagree with probability 0.01 each."""
    twin.save(tmp_path / "bag")
    alone, by_path = twin.compare(), compare(tmp_path / "bag")
    assert alone.to_json() == by_path.to_json()
    assert alone.verdict == "agrees"
    together = compare(tmp_path / "bag", LINE_RING.simulate(seed=4))
    assert [member.name for member in together.pool.members] == [str(tmp_path / "bag"), "run 2"]
    file = write_report(together, tmp_path / "report.html")
    assert file.read_text(encoding="utf-8").startswith("<!")


@pytest.mark.parametrize(
    ("runs", "options", "words"),
    [
        ([], {}, "no run"),
        (["here"], {"level": 0.0}, "level: 0"),
        (["here"], {"level": float("nan")}, "level: nan"),
        (["here", "there"], {}, "here, there: not found"),
    ],
)
def test_compare_refuses(runs: list[str], options: dict[str, float], words: str) -> None:
    with pytest.raises(InputError, match=words):
        compare(*runs, **options)


def test_everything_says_what_it_is(twin: Run) -> None:
    """In a line; and in a notebook as a table, whose rows have equally many cells: every class that is exported."""
    prediction, comparison = LINE_RING.predict(), twin.compare()
    graphs = twin.times[:-1], [LINE_RING.graph_list[mode].name for mode in twin.modes]
    log = Log.from_arrays(twin.times, twin.values, law=LINE_RING, graph=graphs, sampled_law="steps")
    results = [
        (log, ["5 agents", "1001 samples", "line_ring"]),
        (log.compare(), ["line_ring", "agrees", "predicted"]),
        (LINE_RING, ["line_ring", "consensus of 5 agents", "1000 steps"]),
        (twin, ["line_ring", "x(0..1000)", "seed 3", "complete"]),
        (twin.completeness, []),
        (prediction, ["1.41159", "1.35941", "1.5"]),
        (prediction.emulated, ["5 agents", "1.41159"]),
        (comparison, ["agrees", "measured", "predicted 1.41159"]),
        (comparison.system_error, []),
        (compare(twin, LINE_RING.simulate(seed=4)), ["2 runs"]),
        (LINE_RING.leaders(1), ["agents 3", "exhaustive"]),
        (LINE_RING.transient([0, 1]), ["2 times"]),
        (LINE_RING.spectrum([0, 1]), []),
        (msg_analysis.sampled_prediction(LINE_RING, precision=0.1), ["line_ring", "95 % interval", "samples"]),
        (msg_analysis.sweep(LINE_RING, {"switching.scale": [1.0, 2.0]}), ["switching.scale", "2 points"]),
    ]
    for result, words in results:
        text = repr(result)
        assert ("\n" in text, len(text) < 200) == (False, True)
        assert all(word in text for word in words), text
        lines = result._repr_markdown_().splitlines()
        rows = [line for line in lines if line.startswith("|")]
        assert (len(rows) >= 3, lines[-1]) == (True, rows[-1])
        assert any(re.fullmatch(r"(\| -{3}:? )+\|", row) for row in rows)
        assert len({row.count("|") for row in rows}) == 1
    classes = [getattr(msg_analysis, name) for name in msg_analysis.__all__ if name[0].isupper()]
    assert {kind for kind in classes if not issubclass(kind, Exception)} <= {type(each) for each, _ in results}


def test_large_networks_are_short_too() -> None:
    agents = list(range(1, 61))
    graphs = {f"g{i}": {"path": agents if i % 2 else agents[::-1]} for i in range(6)}
    rates = {f"g{i}": {f"g{(i + 1) % 6}": 1.0} for i in range(6)}
    experiment = Experiment.parse({"name": "large", "graphs": graphs, "switching": {"rates": rates}})
    assert "g3, and 2 more;" in repr(experiment)
    assert len(experiment.predict()._repr_markdown_().splitlines()) < 40


def test_plots(twin: Run) -> None:
    """What is drawn: numbers of the run, its comparison, its prediction; notebooks show it as PNG."""
    figure = twin.plot([5, 1], replica=4)
    axes, band = figure.axes
    assert [line.get_label() for line in axes.lines] == ["agent 5", "agent 1"]
    assert np.array_equal(axes.lines[0].get_ydata(), twin.states[:, 4, 3])
    assert np.array_equal(axes.lines[0].get_xdata(), twin.times)
    assert [label.get_text() for label in band.get_yticklabels()] == ["line", "ring"]
    share = [sum(path.get_extents().width for path in each.get_paths()) / twin.times[-1] for each in band.collections]
    np.testing.assert_allclose(share, [np.mean(twin.modes == mode) for mode in (0, 1)])
    comparison = twin.compare()
    compared = comparison.plot()
    above, below = compared.axes
    assert above.lines[0].get_ydata()[-1] == pytest.approx(comparison.system_error.measured)
    prediction = LINE_RING.predict()
    predicted = prediction.plot()
    drawn = predicted.axes[0].lines
    assert len(drawn) == 3
    np.testing.assert_allclose(drawn[0].get_ydata(), prediction.emulated.node_errors)
    assert below.get_xlabel() == "agent"
    for each in (figure, compared, predicted):
        assert each._repr_png_().startswith(b"\x89PNG")
    for agents, replica in (([6], 1), ([0], 1), ([], 1), (None, 0), (None, 17)):
        with pytest.raises(InputError, match=r"agents: |replica: (0|17)"):
            twin.plot(agents, replica=replica)


def test_plots_of_unusual_runs() -> None:
    """One graph, one step, many agents with names, leaders, no prediction, missing states."""
    names = [f"town ${i}_{i}$" for i in range(31)]
    many = Experiment.parse({"name": "many", "names": names, "graphs": {"$x$": {"complete": True}}, "agents": 31})
    many = many.with_run(dt=0.01, duration=0.01)
    run = many.simulate()
    run.states[1, 3] = np.nan
    for figure in (run.plot(), many.predict().plot(), compare(golden("tracking", duration=1).simulate()).plot()):
        assert figure._repr_png_()
