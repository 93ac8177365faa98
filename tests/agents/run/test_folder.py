"""The temporary directory of a run, real processes and all; values of ``run`` from a command line."""

import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest

from msg_agents.run.folder import PREFIX, YOUTH, load_with_overrides, temporary_directory
from msg_analysis.common.shared_folders import own_folder
from msg_analysis.errors import InputError
from msg_analysis.experiment.experiment import Experiment

HOLD = """
import sys, time
from msg_agents.run.folder import temporary_directory
with temporary_directory() as folder:
    (folder / "run.json").write_text("{}")
    print(folder, flush=True)
    time.sleep(600)
"""


@pytest.fixture(autouse=True)
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    return own_folder(tmp_path)


def age(folder: Path, seconds: float) -> None:
    then = time.time() - seconds
    os.utime(folder, (then, then))


def test_gone_afterwards() -> None:
    with temporary_directory() as folder:
        (folder / "log").write_text("x")
    assert not folder.exists()


def test_in_memory_if_there_is_plenty(tmp_path: Path, temporary: Path) -> None:
    memory = tmp_path / "memory"
    with temporary_directory(1, memory) as folder:  # there is none
        assert folder.parent == temporary
    memory.mkdir()
    with (
        temporary_directory(1, memory) as folder,
        temporary_directory(10**18, memory) as too_large,
        temporary_directory(None, memory) as ordinary,
    ):
        assert folder.parent == own_folder(memory)
        assert {too_large.parent, ordinary.parent} == {temporary}
        age(folder, YOUTH + 60)
    abandoned = own_folder(memory) / f"{PREFIX}abandoned"
    abandoned.mkdir()
    age(abandoned, YOUTH + 60)
    with temporary_directory(None, memory):
        assert not abandoned.exists()


def test_of_a_killed_run_is_cleared_and_of_a_living_one_kept(temporary: Path) -> None:
    with (
        subprocess.Popen([sys.executable, "-c", HOLD], stdout=subprocess.PIPE, text=True) as dead,
        subprocess.Popen([sys.executable, "-c", HOLD], stdout=subprocess.PIPE, text=True) as living,
    ):
        abandoned, held = Path(dead.stdout.readline().strip()), Path(living.stdout.readline().strip())
        dead.send_signal(signal.SIGKILL)
        dead.wait()
        for folder in (abandoned, held):
            age(folder, YOUTH + 60)
        with temporary_directory() as mine:
            assert set(temporary.iterdir()) == {held, mine}
        living.kill()


def test_young_ones_and_what_is_no_folder_are_left_alone(temporary: Path) -> None:
    young, file, link = (temporary / f"{PREFIX}{name}" for name in ("young", "file", "link"))
    young.mkdir()
    file.write_text("mine")
    age(file, YOUTH + 60)
    (temporary / "elsewhere").mkdir()
    link.symlink_to(temporary / "elsewhere")
    age(temporary / "elsewhere", YOUTH + 60)
    with temporary_directory():
        assert young.is_dir()
    assert file.read_text() == "mine"
    assert (temporary / "elsewhere").is_dir()


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
