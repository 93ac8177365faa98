"""Names in foreign files cannot give orders to the terminal: no command prints their control characters."""

import json
import re
from pathlib import Path

import many_commands
import pytest
from rich.panel import Panel
from rich.table import Table

from experiments import document
from msg_analysis.common.console import SafeConsole
from msg_analysis.common.text import visible
from msg_analysis.experiment.experiment import Experiment

HOSTILE = "\x1b]0;owned\x07\x9b31m\x1b[2J\u202e"
SHOWN = r"\x1b]0;owned\x07\x9b31m\x1b[2J\u202e"
OF_RICH = re.compile(r"\x1b\[[0-9;]*m|\x1b\[\?25[hl]|\x1b\[[0-9]*[AK]|\r")  # styles, cursor


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("hostile")
    graphs = {f"a{HOSTILE}": {"path": [1, 2, 3]}, f"b{HOSTILE}": {"cycle": [1, 2, 3]}}
    net = document(names=[f"n{i}{HOSTILE}" for i in (1, 2, 3)], graphs=graphs, run={"duration": 10, "seed": 3})
    (folder / "net.yaml").write_text(json.dumps(net))
    (folder / "wrong.yaml").write_text(json.dumps(net | {f"key{HOSTILE}": 1, "problem": HOSTILE}))
    (folder / "sweep.yaml").write_text(f'experiment: net.yaml\nkind: predict\nover: {{"x{chr(92)}e[2J": [1, 2]}}\n')
    run = Experiment.load(folder / "net.yaml").simulate()
    run.save(folder / "bag")
    result = run.compare().to_json()
    result["experiment"] = HOSTILE
    (folder / "result.json").write_text(json.dumps(result))
    return folder


def printed(folder: Path, *jobs: list[str]) -> list[str]:
    """On a terminal, and what goes to stderr."""
    lines = [["msg-analysis", job, "terminal"] for job in jobs]
    found = many_commands.outcomes(lines, folder, COLUMNS="200", TERM="xterm-256color")
    return [OF_RICH.sub("", stdout + stderr) for _, stdout, stderr in found]


def test_every_command_that_prints_names(folder: Path) -> None:
    jobs = [
        ["info", "net.yaml"],
        ["info", "bag"],
        ["predict", "net.yaml"],
        ["facts", "net.yaml"],
        ["transient", "net.yaml", "--times", "0,1"],
        ["compare", "bag"],
        ["leaders", "net.yaml", "--count", "2"],
        ["tabulate", "result.json"],
        ["tabulate", "result.json", "--format", "csv"],
        ["tabulate", "result.json", "--format", "markdown"],
        ["predict", "wrong.yaml"],
        ["sweep", "sweep.yaml", "--out", "out"],
        ["predict", f"{HOSTILE}.yaml"],
        [f"predict{HOSTILE}"],
    ]
    texts = printed(folder, *jobs)
    for job, text in zip(jobs, texts, strict=True):
        assert [char for char in text if char != "\n" and char in "\x1b\x07\x9b\u202e"] == [], job
        assert re.search("[^\n\t -~\xa0-\U0010ffff]", text) is None, job
    assert sum(r"\x1b]0;owned" in text for text in texts) >= 9


def test_texts() -> None:
    assert visible(f"å\n\t{HOSTILE}") == f"å\n\t{SHOWN}"
    assert visible("\r\x00\x7f\x85") == r"\x0d\x00\x7f\x85"


def test_consoles(capsys: pytest.CaptureFixture[str]) -> None:
    """Wherever the text is inside of what is drawn, styles stay."""
    console = SafeConsole(force_terminal=True, color_system="standard", width=120)
    table = Table(HOSTILE)
    table.add_row(Panel(HOSTILE), style="red")
    console.print(table)
    console.print(HOSTILE, style="bold", markup=False)
    text = capsys.readouterr().out
    assert "\x1b[31m" in text
    assert "\x1b[1m" in text
    assert re.search("[\x07\x9b\u202e]|\x1b[^\\[]|\x1b\\[2J", text) is None
