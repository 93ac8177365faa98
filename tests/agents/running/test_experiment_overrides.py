"""Values of ``run`` from a command line: put into the document before its only check."""

from __future__ import annotations

from pathlib import Path

import pytest

from msg_agents.run.folder import load_with_overrides
from msg_analysis.errors import InputError
from msg_analysis.experiment.experiment import Experiment

FILE = Path(__file__).parents[3] / "analysis/msg_analysis/experiment/bundled/line_ring.yaml"


def _changed(directory: Path, run: str) -> Path:
    text = FILE.read_text(encoding="utf-8")
    path = directory / "net.yaml"
    path.write_text(text[: text.index("\nrun:")] + run, encoding="utf-8")
    return path


def test_equal_to_a_change_after_the_check_with_one_check(monkeypatch: pytest.MonkeyPatch) -> None:
    changes = {"seed": 5, "duration": 2.0, "pace": "realtime", "speed": 3.0, "processes": 2}
    wanted = Experiment.load(FILE).with_run(**changes).to_document()
    checks = []
    parse = Experiment.parse
    monkeypatch.setattr(Experiment, "parse", lambda *args, **more: checks.append(1) or parse(*args, **more))
    assert load_with_overrides(FILE, changes | {"processes": "2"}).to_document() == wanted
    assert load_with_overrides(FILE, dict.fromkeys(changes)).to_document() == Experiment.load(FILE).to_document()
    assert len(checks) == 3


def test_a_file_without_run_and_one_whose_value_is_replaced(tmp_path: Path) -> None:
    assert load_with_overrides(_changed(tmp_path, "\n"), {"seed": 5}).run.seed == 5
    wrong = _changed(tmp_path, "\nrun: {seed: -1}\n")
    with pytest.raises(InputError, match=r"run\.seed"):
        load_with_overrides(wrong, {"seed": None})
    assert load_with_overrides(wrong, {"seed": 5}).run.seed == 5


@pytest.mark.parametrize("run", ["\nrun: [1]\n", "\nrun: 3\n"])
def test_mistakes_are_told(tmp_path: Path, run: str) -> None:
    with pytest.raises(InputError, match="run: "):
        load_with_overrides(_changed(tmp_path, run), {"seed": 5})
    with pytest.raises(InputError, match=r"run\.pace"):
        load_with_overrides(FILE, {"pace": ""})
