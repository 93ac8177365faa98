"""No command executes files of the folder that it is started in, nor do the processes that it starts."""

import ast
import json
import re
import subprocess
import sys
from pathlib import Path

from programs import COMMANDS, FOREIGN_NAMES, put_foreign_files

from experiments import document
from msg_analysis.experiment.experiment import Experiment

ROOT = Path(__file__).parents[2]
NOTHING = ("missing",)  # a command that starts no process then imports as much as if it was there
LINES: dict[tuple[str, str], tuple[str, ...]] = {
    **dict.fromkeys(COMMANDS, NOTHING),
    ("msg-analysis", "predict"): ("net.yaml",),
    ("msg-analysis", "compare"): ("bag",),
    ("msg-analysis", "sweep"): ("sweep.yaml", "--out", "out"),  # networks: tests/integration/test_sweep.py
    ("msg-agents", "doctor"): (),
    ("msg-agents", "new"): ("new.yaml",),  # "missing" stays missing: else the command "run" would run it
}
# In one process, since each would import the same again. It is started as an executable is: its folder is on the path.
ALL = f"""
import json, sys
sys.path.append({str(ROOT / "tests/support")!r})
from programs import run
lines = json.load(sys.stdin)
print(json.dumps([run(*words).exit_code for words in lines]))
"""


def test_every_command(tmp_path: Path) -> None:
    assert len(FOREIGN_NAMES) == 23
    folder, bin_folder, executed = tmp_path / "folder", tmp_path / "bin", tmp_path / "executed"
    folder.mkdir()
    bin_folder.mkdir()
    net = document(3, run={"duration": 2, "seed": 1})
    Experiment.parse(net).simulate().save(folder / "bag")
    (folder / "net.yaml").write_text(json.dumps(net))
    (folder / "sweep.yaml").write_text("{experiment: net.yaml, kind: simulate, over: {run.dt: [0.1]}}")
    put_foreign_files(folder, executed)
    (bin_folder / "all.py").write_text(ALL)
    lines = json.dumps([[*command, *words] for command, words in LINES.items()])
    command = [sys.executable, bin_folder / "all.py"]
    process = subprocess.run(command, input=lines, capture_output=True, text=True, cwd=folder, timeout=120)
    assert process.returncode == 0, process.stderr
    codes = dict(zip(LINES, json.loads(process.stdout.splitlines()[-1]), strict=True))
    assert {command for command, code in codes.items() if code == 0} >= {
        command for command, words in LINES.items() if words is not NOTHING
    }
    assert not executed.exists(), executed.read_text()


def test_all_processes_are_started_in_one_place() -> None:
    """Which sets safe paths. What forks, or becomes another program, finds them in its environment."""
    starts = re.compile(
        r"(subprocess\.(Popen|run|call|check_call|check_output)|os\.(system|popen|posix_spawn|spawn)\w*|multiprocessing\..*)$"
    )
    for package in ("analysis/msg_analysis", "msg_agents/msg_agents"):
        for file in (ROOT / package).rglob("*.py"):
            nodes = list(ast.walk(ast.parse(file.read_text(encoding="utf-8"))))
            called = {ast.unparse(node.func) for node in nodes if isinstance(node, ast.Call)}
            assert file.name == "programs.py" or not list(filter(starts.match, called)), file
