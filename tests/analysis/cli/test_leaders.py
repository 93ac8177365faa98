"""``msg-analysis leaders`` and ``msg-analysis figures``: what is printed where, and the exit codes."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from msg_analysis.cli import console
from msg_analysis.cli import main as cli
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.paper import examples

ROOT = Path(__file__).parents[3]
EXPERIMENTS = ROOT / "analysis/msg_analysis/experiment/bundled"
LINE_RING = EXPERIMENTS / "line_ring.yaml"


def call(*arguments: str | Path) -> Result:
    return CliRunner().invoke(cli.main, [str(argument) for argument in arguments])


def leaders(*arguments: str | Path) -> dict:
    result = call("leaders", *arguments, "--json")
    assert (result.exit_code, result.stderr) == (0, "")
    return json.loads(result.stdout)


@pytest.mark.parametrize("method", ["auto", "exhaustive", "greedy", "swap"])
def test_json(method: str) -> None:
    document = leaders(LINE_RING, "--count", "2", "--method", method, "--top", "2")
    assert document["method"] == ("exhaustive" if method == "auto" else method)
    assert document["evaluations"] >= 10 or method == "greedy"
    best = document["sets"][0]
    assert set(best) == {"agents", "system_error", "joint_centrality"}
    assert best["joint_centrality"] == 1 / best["system_error"]
    assert len(document["sets"]) == 2
    if method != "greedy":
        assert [entry["agents"] for entry in document["sets"]] == [[1, 4], [2, 5]]  # the same by symmetry
    assert document["bound"]["system_error"] <= best["system_error"]
    assert document["supermodular"]


def test_orders_of_the_third_example() -> None:
    document = leaders(EXPERIMENTS / "leader_knife_edge.yaml", "--count", "1")
    assert [entry["agents"] for entry in document["sets"]] == [[3], [1], [4], [5], [2]]
    assert round(document["sets"][0]["system_error"], 5) == 1.63896
    assert document["bound"] == {"system_error": document["sets"][0]["system_error"], "gap": 0.0}


def test_laws_and_gains() -> None:
    held = leaders(LINE_RING, "--count", "1")["sets"][0]["system_error"]
    assert leaders(LINE_RING, "--count", "1", "--law", "emulated")["sets"][0]["system_error"] > held
    weak = leaders(LINE_RING, "--count", "1", "--gain", "0.5")
    assert weak["gain"] == 0.5
    assert weak["sets"][0]["system_error"] > held
    assert leaders(EXPERIMENTS / "discrete.yaml", "--count", "1")["law"] == "discrete"


def test_leaders_of_the_file() -> None:
    """Their number and gain unless others are given, and what they achieve beside the best."""
    tracking = EXPERIMENTS / "tracking.yaml"
    document = leaders(tracking)
    assert (document["count"], document["gain"]) == (2, 0.7)
    predicted = Experiment.load(tracking).predict().continuous
    assert document["present"]["agents"] == [1, 4]
    assert document["present"]["system_error"] == pytest.approx(predicted.system_error, rel=1e-9)
    assert document["sets"][0]["system_error"] < document["present"]["system_error"]
    other = leaders(tracking, "--count", "1", "--gain", "inf")
    assert (other["count"], other["gain"], other["present"]["agents"]) == (1, "inf", [1, 4])
    assert "leaders now: 1, 4" in call("leaders", tracking).stdout
    assert leaders(LINE_RING, "--count", "1")["present"] is None
    missing = call("leaders", LINE_RING)
    assert missing.exit_code == 2
    assert "has no leaders: give their number" in missing.stderr


def test_text() -> None:
    result = call("leaders", LINE_RING, "--count", "2")
    assert (result.exit_code, result.stderr) == (0, "")
    for part in ("Sets of 2 leaders, held at the reference", "joint centrality", "1, 4", "no better set exists"):
        assert part in result.stdout
    swap = call("leaders", LINE_RING, "--count", "2", "--method", "swap", "--gain", "2").stdout
    assert "gain 2" in swap
    assert "% above the best" in " ".join(swap.split())
    assert "Single leaders" in call("leaders", LINE_RING, "--count", "1").stdout


def test_no_guarantee_says_why(tmp_path: Path) -> None:
    file = tmp_path / "correlated.yaml"
    file.write_text(
        "name: correlated\ngraphs: {g: {path: [1, 2, 3, 4]}}\n"
        "noise: {process: [[1, 0, 0, 0], [-1, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}\n"
    )
    result = call("leaders", file, "--count", "2", "--method", "greedy")
    assert result.exit_code == 0
    assert "none: the noise of some agents is negatively correlated" in " ".join(result.stdout.split())
    assert leaders(file, "--count", "2", "--method", "greedy")["bound"] == {"system_error": None, "gap": None}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--count", "5"], "count 5: expected 1 to 4"),
        (["--count", "2", "--law", "discrete"], "use continuous or emulated"),
        (["--count", "2", "--gain", "nan"], "gain nan: expected a number > 0"),
        (["--count", "2", "--top", "0"], "top 0: expected a number >= 1"),
        (["--count", "2", "--method", "best"], "--method"),
        ([], "count: "),
    ],
)
def test_bad_usage(options: list[str], message: str) -> None:
    result = call("leaders", LINE_RING, *options)
    assert (result.exit_code, result.stdout) == (2, "")
    assert message in result.stderr
    assert "Traceback" not in result.stderr


def test_progress_without_a_terminal_is_a_line_now_and_then(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(console, "_LINE_PERIOD", 0.0)
    result = call("leaders", LINE_RING, "--count", "2", "--method", "swap", "--json")
    assert json.loads(result.stdout)["sets"]
    assert "line_ring: greedy: 1 of 10, smallest system error" in result.stderr
    assert "\x1b" not in result.stderr


def test_figures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for number, example in list(examples.EXAMPLES.items()):
        monkeypatch.setitem(examples.EXAMPLES, number, lambda example=example: example(5))
    result = call("figures", "--out", tmp_path / "all", "--format", "svg")
    assert (result.exit_code, result.stderr) == (0, "")
    names = [f"example_{number}.{kind}" for number in (1, 2, 3) for kind in ("svg", "csv")]
    assert result.stdout.splitlines() == [str(tmp_path / "all" / name) for name in names]
    assert sorted(path.name for path in (tmp_path / "all").iterdir()) == sorted(names)
    result = call("figures", "1", "--out", tmp_path / "one", "--format", "pdf", "--format", "pdf", "--format", "svg")
    assert sorted(path.suffix for path in (tmp_path / "one").iterdir()) == [".csv", ".pdf", ".svg"]
    (tmp_path / "file").touch()
    result = call("figures", "1", "--out", tmp_path / "file")
    assert (result.exit_code, result.stdout) == (2, "")
    assert "choose another place with --out" in result.stderr
    assert call("figures", "4").exit_code == 2


def test_help_is_light() -> None:
    code = (
        "import sys\nfrom msg_analysis.cli.main import main\n"
        "for command in ('leaders', 'figures'):\n    main([command, '--help'], standalone_mode=False)\n"
        "print([name for name in ('numpy', 'matplotlib', 'rich') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert "Examples:" in done.stdout
    assert done.stdout.endswith("[]\n")
