"""Sweeps from Python, and assert_agrees for tests of other packages."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments import golden
from msg_analysis import ExperimentError, InputError, NotAvailableError, sweep
from msg_analysis.sweeps.grid import load_sweep
from msg_analysis.testing import assert_agrees

LINE_RING = golden("line_ring", duration=20, seed=3, replicas=2)


def test_predictions_are_those_of_the_experiments() -> None:
    scales, noises = np.array([0.5, 2.0]), [1, 2]
    found = sweep(LINE_RING, {"switching.scale": scales, "noise.process": noises})
    table = found.to_dataframe()
    assert table["switching.scale"].tolist() == [0.5, 0.5, 2.0, 2.0]
    for _, row in table.iterrows():
        changed = LINE_RING.with_values({key: float(row[key]) for key in ("switching.scale", "noise.process")})
        assert row["emulated.system_error"] == pytest.approx(changed.predict().emulated.system_error, rel=1e-12)
    assert repr(found) == "<Sweep of 'line_ring' over switching.scale, noise.process: 4 points, predict>"
    axes = found.plot("emulated.system_error").axes[0]
    assert [line.get_xdata().tolist() for line in axes.lines[::2]] == [scales.tolist()] * 2
    assert found.plot()._repr_png_().startswith(b"\x89PNG")


def test_runs_are_those_of_the_command(tmp_path: Path) -> None:
    """The same jobs, with their seeds, as those of a file; a row is the comparison of one run."""
    over = {"switching.scale": [0.5, 2]}
    found = sweep(LINE_RING, over, kind="simulate", repetitions=2)
    file, document = tmp_path / "rates.json", {"experiment": LINE_RING.to_document(), "over": over}
    file.write_text(json.dumps(document | {"kind": "simulate", "repetitions": 2}))
    assert [point.job for point in found.points.points] == [point.job for point in load_sweep(file).points]
    for row in found.rows:
        what = LINE_RING.with_values({"switching.scale": row["switching.scale"]})
        result = what.simulate(seed=row["seed"]).compare()
        assert (row["system_error.measured"], row["verdict"]) == (result.system_error.measured, result.verdict)
    assert found.judgement.verdict == "agrees"


@pytest.mark.parametrize(
    ("over", "options", "words"),
    [
        ({"noise.proces": [1]}, {}, r"point 1 \(noise.proces = 1\): noise.proces: unknown key"),
        ({"run.dt": [0.05, 9]}, {}, r"point 2 \(run.dt = 9\): run.d"),
        ({}, {}, "sweep: over"),
        ({"run.seed": [1]}, {"kind": "guess"}, "sweep: kind"),
        ({"run.seed": [1, 2]}, {"kind": "simulate", "repetitions": 2}, "repetitions: 2: expected 1"),
        ({"run.seed": [1, 2], "run.dt": [0.05]}, {"combine": "zip"}, "as many values of every key"),
    ],
)
def test_mistakes(over: dict[str, Any], options: dict[str, Any], words: str) -> None:
    with pytest.raises(ExperimentError, match=words) as caught:
        sweep(LINE_RING, over, **options)
    assert "--" not in str(caught.value)


def test_a_column_that_is_not_there() -> None:
    with pytest.raises(InputError, match="column nonsense: not a column of numbers"):
        sweep(LINE_RING, {"run.seed": [1]}).plot("nonsense")


def test_without_pandas(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pandas", None)
    with pytest.raises(NotAvailableError, match="pandas is not installed"):
        sweep(LINE_RING, {"run.seed": [1]}).to_dataframe()


def test_assert_agrees() -> None:
    """A run of its own law passes, with fixed seeds; that of another one does not, and the reason is said."""
    run = LINE_RING.with_run(duration=200).simulate(seed=1)
    assert assert_agrees(run, LINE_RING.with_run(duration=200).simulate(seed=2)).verdict == "agrees"
    run.states[:] *= 2.0
    with pytest.raises(AssertionError, match=r"disagrees.*system error.*adjusted p"):
        assert_agrees(run)
    run.states[50, 1] = np.nan
    short = LINE_RING.simulate()
    short.states[-1, 0] = np.nan
    with pytest.raises(InputError, match="level"):
        assert_agrees(short, level=2.0)
