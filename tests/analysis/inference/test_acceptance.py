"""Acceptance tests of a number per run: error rates at any time, the file between calls, JUnit, pytest."""

import json
import math
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from pages import ROOT, blocks
from scipy.integrate import quad
from scipy.stats import beta

from msg_analysis.errors import InputError
from msg_analysis.inference.e_values import share_evidence
from msg_analysis.testing import Acceptance, Claim, accept

pytest_plugins = ["pytester"]
ASKED, LEVEL = 0.95, 0.01


def numbers(share: float, seed: int = 0) -> Iterator[float]:
    """Times to a goal, of which this share is at most 30."""
    random = np.random.default_rng(seed)
    while True:
        yield 20.0 if random.random() < share else 40.0


@pytest.mark.parametrize(("good", "bad"), [(0, 0), (12, 0), (40, 7), (3, 9)])
def test_evidence_by_quadrature(good: int, bad: int) -> None:
    """The mean of the likelihood ratio over the prior, which is cut off at the share."""
    prior = beta(5 * 0.9, 5 * 0.1)
    ratio = lambda q: (q / 0.9) ** good * ((1 - q) / 0.1) ** bad * prior.pdf(q)  # noqa: E731
    expected = quad(ratio, 0.0, 0.9, epsabs=0.0, limit=200)[0] / prior.cdf(0.9)
    assert share_evidence(np.array(good), np.array(bad), 0.9) == pytest.approx(math.log(expected), rel=1e-6)


def decisions(share: float, runs: int = 2000, repeats: int = 2000) -> tuple[np.ndarray, np.ndarray]:
    """(repeats,) whether a claim of 0.95 is rejected ever, and after how many runs."""
    good = np.cumsum(np.random.default_rng(1).random((repeats, runs)) < share, axis=1)
    bad = np.arange(1, runs + 1) - good
    # Of each pair of numbers once: the repeats have most of them in common.
    number, failures = np.ogrid[1 : runs + 1, : bad.max() + 1]
    rejects = share_evidence((number - failures).clip(0), failures, ASKED) >= -math.log(LEVEL)
    rejected = rejects[np.arange(runs), bad]
    return rejected.any(axis=1), rejected.argmax(axis=1) + 1


def test_correct_claims_are_hardly_ever_rejected() -> None:
    """Of 2,000 with just the share that is asked, tested after each of 2,000 runs: 1 % at most, and 33 with p 0.003."""
    rejected, _ = decisions(ASKED)
    assert rejected.sum() <= 33


def test_a_share_of_0_90_is_found() -> None:
    """Half of them within 237 runs; no bound on a time, but on a number of runs."""
    rejected, runs = decisions(0.90)
    assert rejected.all()
    assert 200 < np.median(runs) < 280


def test_what_is_decided_and_when() -> None:
    always = accept(lambda: 10.0, at_most=30.0, in_share=ASKED, name="time to goal")
    assert (always.decision, len(always.values)) == ("accepted", 52)  # by hand: quadrature of 0.9^-n over the prior
    with pytest.raises(AssertionError, match=r"^rejected: time at most 30 in 95 % of the runs: .* below 95 %") as found:
        accept(numbers(0.5), at_most=30.0, name="time")
    assert "40  no" in str(found.value)
    assert accept([1.0, 2.0, 3.0], at_least=0.5, at_most=2.5).decision == "open"
    assert accept([1.0, math.nan, 3.0], at_least=0.5).good == 2
    assert not any(Claim("x", 1.0, 2.0, 0.9, 0.1, 0.01).holds(value) for value in (0.9, 2.1, math.nan, math.inf))


def test_state_and_junit(tmp_path: Path) -> None:
    """The runs of earlier calls count; those of another revision do not; what is decided needs no more runs."""
    state, junit = tmp_path / "time.json", tmp_path / "junit.xml"
    given: dict[str, Any] = {"at_most": 30.0, "state": state, "junit": junit}
    assert len(accept(lambda: math.inf, **given, most=1).values) == 1
    assert json.loads(state.read_text())["values"] == ["inf"]
    assert ElementTree.parse(junit).getroot().find("testcase/skipped") is not None
    second = accept(lambda: 1.0, **given, most=40)
    assert (second.decision, second.values[:2]) == ("open", (math.inf, 1.0))
    assert accept(lambda: 1.0, **given, revision="other", most=5).values == (1.0,) * 5
    third = accept(lambda: 1.0, **given, revision="other")
    assert (third.decision, len(third.values)) == ("accepted", 52)
    assert accept(lambda: 1 / 0, **given, revision="other").values == third.values
    suite = ElementTree.parse(junit).getroot()
    assert (suite.get("failures"), suite.get("skipped")) == ("0", "0")
    with pytest.raises(AssertionError):
        accept(lambda: 50.0, at_most=30.0, junit=junit)
    failure = ElementTree.parse(junit).getroot().find("testcase/failure")
    assert failure is not None
    assert failure.get("message", "").startswith("rejected: metric at most 30")


def test_two_jobs_at_once(tmp_path: Path) -> None:
    """Two processes with one file: no run of either is lost, and their numbers tell which."""
    script = "import sys; from msg_analysis.testing import accept; n = float(sys.argv[1])\n"
    script += "accept(iter([n] * 20), at_most=1.0, in_share=0.99, margin=0.01, most=20, state=sys.argv[2])"
    state = tmp_path / "state.json"
    jobs = [subprocess.Popen([sys.executable, "-c", script, str(n), str(state)]) for n in (0.25, 0.75)]
    assert [job.wait(timeout=60) for job in jobs] == [0, 0]
    values = json.loads(state.read_text())["values"]
    assert sorted(values) == [0.25] * 20 + [0.75] * 20
    assert [path.name for path in tmp_path.iterdir()] == ["state.json"]


def test_a_run_that_raises_loses_nothing(tmp_path: Path) -> None:
    def metric() -> float:
        count = len(json.loads(state.read_text())["values"]) if state.exists() else 0
        if count == 3:
            raise OSError("the simulator is gone")
        return 1.0

    state = tmp_path / "state.json"
    with pytest.raises(OSError, match="simulator"):
        accept(metric, at_most=2.0, state=state)
    assert json.loads(state.read_text())["values"] == [1.0, 1.0, 1.0]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "at_least, at_most: None, None: expected one or both, ascending"),
        ({"at_least": 3.0, "at_most": 2.0}, "at_least, at_most: 3.0, 2.0: expected"),
        ({"at_most": math.nan}, "at_least, at_most: None, nan: expected"),
        ({"at_most": 1, "in_share": 1.0}, "in_share: 1.0: expected a share above 0, below 1"),
        ({"at_most": 1, "margin": 0.95}, "margin: 0.95: expected above 0, below in_share"),
        ({"at_most": 1, "level": 0.9}, "level: 0.9: expected above 0, at most 0.5"),
        ({"at_most": 1, "most": 0}, "most: 0: expected a number of runs from 1"),
    ],
)
def test_mistakes(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError) as error:
        accept([1.0], **arguments)
    assert str(error.value).startswith(message)


def test_values_and_files_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="time: 'soon': expected a number per run, or nan"):
        accept(["soon"], at_most=1.0, name="time")  # type: ignore[list-item]
    state = tmp_path / "state.json"
    for text in ("{", "[]", '{"claim": {}}', "[" * 100_000, '{"claim": {}, "revision": null, "values": ["x"]}'):
        state.write_text(text)
        with pytest.raises(InputError, match=r"state\.json: not a state of `accept` .*: give another one"):
            accept([1.0], at_most=1.0, state=state)
    state.unlink()
    accept([1.0], at_most=1.0, state=state)
    with pytest.raises(InputError, match=r"a state of another claim: expected one of this claim, metric at most 2"):
        accept([1.0], at_most=2.0, state=state)


PLUGIN = """
def test_time(accept):
    accept(iter([1.0] * {}), at_most=2.0, name="time")

def test_bag(assert_agrees):
    from msg_analysis import Experiment
    assert_agrees(Experiment.load("line_ring").with_run(duration=20).simulate())
"""


def test_plugin(pytester: pytest.Pytester, request: pytest.FixtureRequest) -> None:
    """Two calls of pytest: the first leaves the claim open, the second goes on, with a page of the comparison."""
    pytester.makepyfile(PLUGIN.format(30))
    installed = request.config.pluginmanager.hasplugin("msg_analysis")
    plugin = [] if installed else ["-p", "msg_analysis.pytest_plugin"]
    options = [*plugin, "--msg-state", "state", "--msg-revision", "a1"]
    pytester.runpytest_inprocess(*options, "-k", "time").assert_outcomes(skipped=1)
    result = pytester.runpytest_inprocess(*options, "--msg-report", "pages", "--junit-xml", "junit.xml")
    result.assert_outcomes(passed=2)
    assert [page.name for page in (pytester.path / "pages").iterdir()] == ["test_plugin.py_test_bag.html"]
    assert "accepted: time at most 2 in 95 % of the runs" in (pytester.path / "junit.xml").read_text()


def test_what_the_page_shows(pytester: pytest.Pytester, request: pytest.FixtureRequest) -> None:
    *_, shown = blocks(ROOT / "docs/flaky_tests.md", "python")
    pytester.makepyfile(shown)
    installed = request.config.pluginmanager.hasplugin("msg_analysis")
    plugin = [] if installed else ["-p", "msg_analysis.pytest_plugin"]
    pytester.runpytest_inprocess(*plugin).assert_outcomes(passed=1, skipped=1)


def test_words() -> None:
    found = Acceptance(Claim("time", None, 30.0, 0.95, 0.05, 0.01), (10.0,) * 19 + (40.0,))
    assert found.words == (
        "open: time at most 30 in 95 % of the runs: 19 of 20 runs (95 %); not known yet: more runs are needed"
    )
    assert str(found).splitlines()[-1].split() == ["20", "40", "no"]
