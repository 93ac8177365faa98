"""Every way in which a protocol, or an experiment that asks for one, can be wrong: said in a line, with its name."""

import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from euler import DIRECTED, Euler, EulerSteps, document, experiment

from experiments import Experiment, predict, simulate
from msg_analysis.cli.main import main
from msg_analysis.common.arrays import FloatArray
from msg_analysis.errors import InputError
from msg_analysis.experiment import protocols
from msg_analysis.experiment.problems import ExperimentError
from msg_analysis.protocol import Heard, LinearProtocol, Parameters, Protocol

SATURATED, METROPOLIS = {"name": "saturated"}, {"name": "metropolis"}
INTEGRAL, ITS_PACKAGE = {"name": "integral_action"}, "(msg_agents_example_protocols 0.1.0)"
NOT_LINEAR = f"protocol saturated {ITS_PACKAGE} has no prediction to start from: for example start: zero"
TWO_VALUES = f"protocol integral_action {ITS_PACKAGE}, agent 1: disturbance: 2 values, expected one for each of the 5 "
UNKNOWN = 'protocol.name: "metropolys": expected one of ' + ", ".join(
    f"{name} {ITS_PACKAGE}" for name in ("integral_action", "metropolis", "saturated")
)
LEADERS: dict[str, Any] = {"problem": "tracking", "leaders": {"agents": [1]}}
MISTAKES: list[tuple[Any, dict[str, Any], list[str]]] = [
    ({"name": "metropolys"}, {}, [f"{UNKNOWN}: did you mean metropolis?"]),
    ({"laziness": 0.5}, {}, ["protocol.name: missing: expected the name under which"]),
    (METROPOLIS | {"lazyness": 0.5}, {}, ["protocol.lazyness: unknown key: expected one of laziness: did you mean 'l"]),
    (METROPOLIS | {"laziness": 1}, {}, ["protocol.laziness: 1: expected a number < 1: for example laziness: 0.5"]),
    (
        METROPOLIS | {"laziness": -1},
        {"noise": {"broadcast": -2}},
        ["protocol.laziness: -1: expected a number >= 0", "noise.broadcast: -2: expected a number >= 0"],
    ),
    (SATURATED | {"limit": "much"}, {}, ['protocol.limit: "much": ']),
    (SATURATED | {"limit": float("nan")}, {}, ["protocol.limit: .nan: expected a finite number"]),
    (INTEGRAL | {"disturbance": [1, 2]}, {}, [f"{TWO_VALUES}agents: correct the parameters, or tell the authors of"]),
    (METROPOLIS, {"graphs": DIRECTED}, ["graph a is directed, expected undirected graphs: correct"]),
    (
        SATURATED,
        {"run": {"start": "stationary"}},
        [f"run.start: 'stationary': expected 'zero' or one value per agent, since {NOT_LINEAR}"],
    ),
    (SATURATED, LEADERS, ["problem: 'tracking': expected consensus, since protocol saturated"]),
    ("metropolis", {}, ['protocol: "metropolis": expected keys with values: for example protocol: {"name"']),
]


@pytest.mark.parametrize(("protocol", "changes", "expected"), MISTAKES, ids=str)
def test_mistakes_in_the_file(protocol: Any, changes: dict[str, Any], expected: list[str]) -> None:
    with pytest.raises(ExperimentError) as caught:
        Experiment.parse(document(protocol, **changes))
    assert len(caught.value.problems) == len(expected)
    for text in expected:
        assert any(text in line for line in caught.value.problems), caught.value.problems


def test_dt_is_the_protocols_own_matter() -> None:
    """The stability limit is that of the built-in law."""
    assert experiment(METROPOLIS, run={"dt": 5.0}).step_length == 5.0


def declares(matrix: Any) -> type[LinearProtocol]:
    class Declares(LinearProtocol):
        def weights(self, mode: int) -> FloatArray:
            return matrix() if callable(matrix) else np.array(matrix, dtype=float)

    return Declares


def steps(step: Callable[[int, FloatArray], Any]) -> type[Protocol]:
    class Steps(Protocol):
        def step(self, k: int, mode: int, state: FloatArray, heard: Heard, noise: FloatArray) -> FloatArray:
            return step(k, state) if self.agent == 2 else state

    return Steps


CLIQUE = np.full((5, 5), 0.2)


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        (declares(np.eye(4)), "graph line: weights: result of shape (4, 4), expected (5, 5)"),
        (declares(np.full((5, 5), np.nan)), "graph line: weights: the result is not finite"),
        (declares(2 * np.eye(5)), "graph line: weights: row of agent 1 sums to 2, expected 1"),
        (declares(CLIQUE), "graph line: weights: agent 1 uses agent 3 with 0.2, expected 0, since it does not hear it"),
        (declares(lambda: {}["key"]), "graph line: weights: KeyError: 'key'"),
        (type("Many", (EulerSteps,), {"states": 0}), "agent 1: states: 0, expected a whole number >= 1"),
        (
            type("Wrong", (EulerSteps,), {"publish": lambda self, state: state}),
            "agent 1, publish, step 0: result of shape (1, 3), expected (3,)",
        ),
        (
            type("Starts", (EulerSteps,), {"start": lambda self, value: value}),
            "agent 1, start: result of shape (3,), expected (1, 3)",
        ),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_mistakes_of_protocols(kind: Any, expected: str, offer: Callable[..., None]) -> None:
    """Found when the experiment is read."""
    offer(("mine", kind))
    with pytest.raises(ExperimentError) as caught:
        experiment({"name": "mine"})
    assert f": protocol mine (pack 1.2), {expected}" in str(caught.value)


def test_agents_with_names(offer: Callable[..., None]) -> None:
    """They are named, not numbered."""
    names = ["Ulm", "Bonn", "Kiel", "Bad Ems", "Hof"]
    for kind, expected in (
        (declares(CLIQUE), "graph line: weights: agent Ulm uses agent Kiel with 0.2, expected 0"),
        (declares(2 * np.eye(5)), "weights: row of agent Ulm sums to 2"),
        (type("Many", (EulerSteps,), {"states": 0}), "agent Ulm: states: 0"),
    ):
        offer(("mine", kind))
        with pytest.raises(ExperimentError) as caught:
            experiment({"name": "mine"}, names=names)
        assert expected in str(caught.value)
    offer(("mine", steps(lambda k, state: 1 / (k - 17) + state)))
    with pytest.raises(InputError, match="agent Kiel, step 17: ZeroDivisionError"):
        simulate(experiment({"name": "mine"}, names=names))


@pytest.mark.parametrize(
    ("step", "expected"),
    [
        (lambda k, state: 1 / (k - 17) + state, "ZeroDivisionError: division by zero"),
        (lambda k, state: state * (np.nan if k == 17 else 1), "the result is not finite"),
        (lambda k, state: state * (1e200 if k == 17 else 1) + 1e200, "the result is not finite"),
        (lambda k, state: state * (1j if k == 17 else 1), "the result is complex, expected real numbers"),
        (lambda k, state: sys.exit(0) if k == 17 else state, "SystemExit: 0"),
        (lambda k, state: os._exit(0) if k == 17 else state, "SystemExit: os._exit(0)"),
        (lambda k, state: state[0] if k == 17 else state, "result of shape (3,), expected (1, 3)"),
        (lambda k, state: None if k == 17 else state, "result of shape (), expected (1, 3)"),
        (lambda k, state: state.__imul__(2) if k == 17 else state, "output array is read-only"),
    ],
)
def test_steps_that_fail(step: Any, expected: str, offer: Callable[..., None], tmp_path: Path) -> None:
    """Exit code 2 and one line that says where, with the line of what raised; that is kept for whoever calls."""
    offer(("mine", steps(step)))
    with pytest.raises(InputError) as caught:
        simulate(experiment({"name": "mine"}))
    raised = isinstance(caught.value.__cause__, (ZeroDivisionError, SystemExit)) or "read-only" in expected
    place = f" ({__file__}, line {step.__code__.co_firstlineno})" if raised else ""
    assert str(caught.value) == f"protocol mine (pack 1.2), agent 3, step 17: {expected}{place}"
    assert isinstance(caught.value.__cause__, BaseException)
    file = tmp_path / "net.json"
    file.write_text(json.dumps(document({"name": "mine"})))
    outcome = CliRunner().invoke(main, ["simulate", str(file), "--out", str(tmp_path / "bag")])
    assert (outcome.exit_code, outcome.stdout) == (2, "")
    assert outcome.stderr == f"error: {caught.value}\n"
    assert not (tmp_path / "bag").exists()


class Named(Parameters):
    name: str = "other"


def test_packages_that_cannot_be_used(offer: Callable[..., None]) -> None:
    def broken() -> None:
        raise ImportError("no module named foo")

    for offers, expected in (
        ([], "expected a protocol, but no installed package offers any"),
        (
            [("mine", broken)],
            "mine: cannot be imported (ImportError: no module named foo): expected pack.module:mine of package pack",
        ),
        ([("mine", type("Odd", (Euler,), {"Parameters": dict}))], "mine: AttributeError: type object 'dict' has no"),
        ([("mine", type("Odd", (Euler,), {"Parameters": Named}))], "mine: ValueError: they have a field 'name'"),
        ([("mine", lambda: dict)], "mine: pack.module:mine of package pack 1.2 is type dict: expected a class derived"),
        ([("mine", Euler), ("mine", EulerSteps)], '"mine" of mine (pack 1.2), mine (pack 1.2): expected one package'),
    ):
        offer(*offers)
        with pytest.raises(ExperimentError) as caught:
            experiment({"name": "mine"})
        assert expected in str(caught.value)


@pytest.mark.parametrize(
    "command",
    [["predict"], ["facts"], ["plan"], ["spectrum"], ["leaders", "--count", "1"], ["transient", "--times", "0"]],
)
def test_no_prediction_is_refused_clearly(command: list[str], tmp_path: Path) -> None:
    file = tmp_path / "net.json"
    file.write_text(json.dumps(document(SATURATED)))
    outcome = CliRunner().invoke(main, [command[0], str(file), *command[1:]])
    assert outcome.exit_code == 2
    assert outcome.stderr.startswith(f'error: {file}: protocol.name: "saturated": expected a linear protocol, but')
    assert "without a prediction: use `simulate` or `msg-agents run`" in outcome.stderr
    with pytest.raises(InputError, match="is not linear"):
        predict(Experiment.load(file))


def test_processes_that_a_protocol_forks_end_as_ever() -> None:
    """``os._exit`` is an error in the process that calls the protocol only."""

    def fork() -> int:
        pid = os.fork()
        if not pid:
            os._exit(7)
        return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])

    with protocols._KeptAlive():
        assert fork() == 7
        with pytest.raises(SystemExit, match=r"os\._exit\(0\)"):
            os._exit(0)
    assert fork() == 7


def test_a_package_that_is_installed_meanwhile_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And one that is removed is not: what packages offer is kept only as long as no directory of them changes."""
    monkeypatch.syspath_prepend(tmp_path)
    before = set(protocols.installed_protocols())
    assert "saturated" in before
    info = tmp_path / "later-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: later\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[msg_agents.protocols]\nlater = later:Later\n")
    os.utime(tmp_path, ns=(1, 1))  # file systems count in ticks, of which this may be the same
    assert set(protocols.installed_protocols()) == before | {"later"}
    info.rename(tmp_path / "gone")
    os.utime(tmp_path, ns=(2, 2))
    assert set(protocols.installed_protocols()) == before
