"""Results of the examples as they were before the packages were rearranged, in tests/data/golden/examples.json.

Numbers agree to 1e-9 of the largest in their list; of lists with more than eight numbers, shape and sums are kept.
"""

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy
from click.testing import CliRunner

from experiments import Experiment
from msg_analysis.cli.main import main
from msg_analysis.experiment.examples import names

GOLDEN = json.loads((Path(__file__).parents[2] / "data/golden/examples.json").read_text())
COMMANDS = {
    "predict": (),
    "leaders": ("--count", "1"),
    "plan": (),
    "spectrum": (),
    "transient": ("--times", "0,1,5,20"),
    "facts": (),
    "info": (),
}
TOLERANCE = 3e-9 if scipy.__version__.startswith("1.11.") else 1e-9  # whose noncentral chi-square is less exact


def essence(value: Any) -> Any:
    """The document without texts, which may change, and without what solvers say of their rounding."""
    if isinstance(value, dict):
        return {key: essence(entry) for key, entry in value.items() if key not in ("solver", "versions")}
    if isinstance(value, str):
        return ""
    if not isinstance(value, list):
        return value
    try:
        numbers = np.array(value, dtype=float)
    except (TypeError, ValueError):  # not all numbers, or of different lengths
        return [essence(entry) for entry in value]
    if numbers.size <= 8:
        return value
    sums = [np.abs(numbers).sum(), numbers.sum(), numbers.ravel() @ np.linspace(0, 1, numbers.size)]
    return {"shape": list(numbers.shape), "sums": sums}


def agree(found: Any, golden: Any, place: str, scale: float = 0.0) -> None:
    if isinstance(golden, dict):
        assert found.keys() == golden.keys(), place
        for key in golden:
            # Of a residual, which is rounding, the scale is 1: it was computed from numbers of that size.
            agree(found[key], golden[key], f"{place}.{key}", 1.0 if key == "residual" else 0.0)
    elif isinstance(golden, list):
        assert len(found) == len(golden), place
        scale = max([scale, *(abs(number) for number in golden if isinstance(number, float))])
        for index, (one, other) in enumerate(zip(found, golden, strict=True)):
            agree(one, other, f"{place}[{index}]", scale)
    elif isinstance(golden, float):
        assert found == pytest.approx(golden, rel=TOLERANCE, abs=TOLERANCE * scale), place
    else:
        assert found == golden, place


def test_what_needs_a_chain() -> None:
    """Each command has numbers of each example, or says why there are none."""
    missing = [(command, name) for name in names() for command in COMMANDS if command not in GOLDEN[name]]
    assert missing == [(command, "recorded_robots") for command in ("leaders", "plan", "spectrum", "facts")]
    for command, name in missing:
        result = CliRunner().invoke(main, [command, name, *COMMANDS[command]])
        assert result.exit_code == 2
        assert "has no steady state, expected a Markov chain for this" in result.stderr


@pytest.mark.parametrize(("command", "name"), [(c, n) for c in COMMANDS for n in names() if c in GOLDEN[n]])
def test_numbers(command: str, name: str) -> None:
    result = CliRunner().invoke(main, [command, name, *COMMANDS[command], "--json"])
    assert result.exit_code == 0, result.output
    agree(essence(json.loads(result.stdout)), GOLDEN[name][command], command)


@pytest.mark.parametrize("name", names())
def test_states(name: str) -> None:
    """To the last bit: of 50 units of time, or as long as the experiment says."""
    experiment = Experiment.load(name)
    run = (experiment if name == "discrete" else experiment.with_run(duration=50)).simulate()
    found = [hashlib.sha256(values.tobytes()).hexdigest() for values in (run.states, run.modes)]
    assert found == GOLDEN[name]["states"]


def test_a_change_is_found() -> None:
    """Of a number in a long list, of a small one beside large ones, of a key, and of a length."""
    numbers = [1000.0, *np.arange(1.0, 20.0)]
    golden = essence({"a": numbers, "b": [1.0, 1e-6], "c": 3})
    agree(essence({"a": numbers, "b": [1.0, 1e-6 + 1e-12], "c": 3}), golden, "")
    swapped, wrong = [*numbers[:-2], *numbers[:-3:-1]], [*numbers[:-1], 19.00001]
    for changes in ({"a": swapped}, {"a": wrong}, {"a": numbers[1:]}, {"b": [1.0, 1.1e-6]}, {"c": 4}, {"d": 1}):
        with pytest.raises(AssertionError):
            agree(essence({"a": numbers, "b": [1.0, 1e-6], "c": 3} | changes), golden, "")
