"""The commands ``runs`` and ``diff``: what they print, and their exit codes."""

import dataclasses
import io
import json
from datetime import UTC, datetime
from pathlib import Path

import pytest
import yaml
from click.testing import Result
from programs import PROGRAMS, run
from rich.console import Console

from msg_analysis import Experiment
from msg_analysis.common.text import json_text
from msg_analysis.report.tables import print_runs
from msg_analysis.runs import list_runs

LINE = {"line": {"path": [1, 2, 3]}}
DOCUMENT = {"name": "pair", "graphs": LINE, "run": {"dt": 0.1, "duration": 20, "seed": 7, "start": "zero"}}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two runs, one of them compared, a foreign folder, and two experiments."""
    place = tmp_path_factory.mktemp("place")
    for seed in (7, 8):
        made = Experiment.parse(DOCUMENT).simulate(seed=seed)
        started = datetime(2026, 11, 20 + seed, 12, tzinfo=UTC)
        made = dataclasses.replace(made, record=dataclasses.replace(made.record, started=started))
        made.save(place / "runs" / f"pair_2026112{seed}_120000")
    result = made.compare().to_json()
    (place / "runs" / "pair_20261128_120000" / "result.json").write_text(json_text(result))
    (place / "runs" / "photos").mkdir()
    (place / "runs" / "photos" / "a.jpg").write_text("")
    (place / "a.yaml").write_text(yaml.safe_dump(DOCUMENT))
    (place / "b.yaml").write_text(yaml.safe_dump(DOCUMENT | {"noise": {"process": 2.0}}))
    return place


@pytest.fixture(autouse=True)
def _there(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)


def invoke(*words: str, code: int = 0, columns: int = 120) -> Result:
    result = run("msg-analysis", *words, COLUMNS=str(columns))
    assert (result.exit_code, result.exception if code == 0 else None) == (code, None), result.output
    return result


def test_both_programs_have_one_command() -> None:
    assert PROGRAMS["msg-agents"].commands["runs"] is PROGRAMS["msg-analysis"].commands["runs"]


def test_runs() -> None:
    text = invoke("runs").stdout
    assert "3 runs: " in text
    for word in ("photos", "foreign", "not compared", "agrees", "2026-11-27 12:00"):
        assert word in text
    text = invoke("runs", "--name", "pair").stdout
    assert "2 runs of 3" in text
    assert "2026-11-27 12:00" not in text  # the names of the folders have it
    piped = invoke("runs", columns=40).stdout.splitlines()  # nothing is cut or left out where no terminal is
    assert {"predicted", "z"} < set(piped[2].split())
    (line,) = (line for line in piped if "pair_20261128_120000" in line)
    assert "2026-11-28 12:00" in line
    assert "agrees" in line
    assert "none of 3 runs" in invoke("runs", "--seed", "9").stdout
    document = json.loads(invoke("runs", "--verdict", "agrees", "--json").stdout)
    assert (document["folder"], document["total"]) == ("runs", 3)
    assert [run["seed"] for run in document["runs"]] == [8]


def test_runs_on_a_narrow_terminal() -> None:
    """A line for each run, whose name is whole; numbers are left out."""
    console = Console(file=io.StringIO(), width=40, force_terminal=True, color_system=None)
    found = list_runs(Path("runs"))
    print_runs(found, Path("runs"), len(found), console)
    lines = console.file.getvalue().splitlines()
    assert not {"predicted", "z"} & set(lines[2].split())
    assert sum(" pair_20261128_120000 " in line for line in lines) == 1


def test_page(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is opened where there is a display; elsewhere its place is said."""
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"):
        monkeypatch.delenv(name, raising=False)
    assert invoke("runs", "--page", "page.html").stdout == "page.html\n"
    result = invoke("runs", "--open", "--seed", "8")
    place = Path("runs/index.html")
    assert result.stdout == f"{place}\n"
    assert f"no display here: open {place.absolute().as_uri()} in a browser" in result.stderr
    assert "pair_20261127_120000" not in place.read_text()
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", lambda address: not opened.append(address))
    monkeypatch.setenv("DISPLAY", ":0")
    assert json.loads(invoke("runs", "--open", "--json").stdout)["page"] == str(place)
    assert opened == [place.absolute().as_uri()]
    assert "no such directory" in invoke("runs", "--page", "none/page.html", code=2).stderr


def test_diff_of_bags() -> None:
    bags = [f"runs/pair_2026112{seed}_120000" for seed in (7, 8)]
    text = invoke("diff", *bags).stdout
    for words in ("run.seed", "A: 7", "first difference at step 1", "in standard errors", "Versions: no difference"):
        assert words in text
    assert json.loads(invoke("diff", *bags, "--json").stdout)["kind"] == "bags"
    same = invoke("diff", bags[0], bags[0]).stdout
    assert "equal to the last bit, x(0) to x(200)" in same
    assert "same seed" in same


def test_diff_of_experiments() -> None:
    text = invoke("diff", "a.yaml", "b.yaml").stdout
    for words in ("noise.process", "+300 %", "Decay rates", "best of A"):
        assert words in text
    assert json.loads(invoke("diff", "a.yaml", "b.yaml", "--json").stdout)["kind"] == "experiments"


def test_agents_have_their_names(tmp_path: Path) -> None:
    """Where both files have the same ones."""
    named = DOCUMENT | {"names": ["Ulm", "Bonn", "Kiel"]}
    for place, extra in (("a", {}), ("b", {"noise": {"process": 2.0}})):
        (tmp_path / f"{place}.yaml").write_text(yaml.safe_dump(named | extra))
        Experiment.load(tmp_path / f"{place}.yaml").simulate().save(tmp_path / place)
    text = invoke("diff", str(tmp_path / "a.yaml"), str(tmp_path / "b.yaml")).stdout
    assert "agent Kiel" in text
    assert "agent 1" not in text
    assert "agent Ulm" in invoke("diff", str(tmp_path / "a"), str(tmp_path / "b")).stdout
    assert "agent 1" in invoke("diff", str(tmp_path / "a.yaml"), "b.yaml").stdout


@pytest.mark.parametrize(
    ("words", "error"),
    [
        (("diff", "a.yaml", "runs/pair_20261127_120000"), "expected two bags or two experiment files"),
        (("diff", "runs/pair_20261127_120000", "a.yaml"), "expected two bags or two experiment files"),
        (("diff", "runs/photos", "runs/photos"), "not a bag"),
        (("diff", "a.yaml", "none.yaml"), "none.yaml"),
        (("runs", "none"), "expected a folder with the folders of runs"),
        (("runs", "--since", "soon"), "--since soon: expected a date"),
    ],
)
def test_mistakes(words: tuple[str, ...], error: str) -> None:
    result = invoke(*words, code=2)
    assert error in result.stderr
    assert result.stderr.count("error:") == 1
    assert result.stdout == ""
