"""The temporary folder of a run, real processes and all."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest

from msg_agents.run import folder as module
from msg_agents.run.folder import PREFIX, YOUTH, temporary_directory

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
    return tmp_path


def age(folder: Path, seconds: float) -> None:
    then = time.time() - seconds
    os.utime(folder, (then, then))


def test_gone_afterwards() -> None:
    with temporary_directory() as folder:
        (folder / "log").write_text("x")
    assert not folder.exists()


def test_in_memory_if_there_is_plenty(tmp_path: Path, temporary: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    memory = tmp_path / "memory"
    monkeypatch.setattr(module, "MEMORY", memory)
    with temporary_directory(1) as folder:  # there is none
        assert folder.parent == temporary
    memory.mkdir()
    with temporary_directory(1) as folder, temporary_directory(10**18) as too_large, temporary_directory() as ordinary:
        assert folder.parent == memory
        assert {too_large.parent, ordinary.parent} == {temporary}
        age(folder, YOUTH + 60)
    (memory / f"{PREFIX}abandoned").mkdir()
    age(memory / f"{PREFIX}abandoned", YOUTH + 60)
    with temporary_directory():
        assert list(memory.iterdir()) == []


def test_of_a_killed_run_is_cleared_and_of_a_living_one_kept(temporary: Path) -> None:
    with (
        subprocess.Popen([sys.executable, "-c", HOLD], stdout=subprocess.PIPE, text=True) as dead,
        subprocess.Popen([sys.executable, "-c", HOLD], stdout=subprocess.PIPE, text=True) as living,
    ):
        assert dead.stdout is not None
        assert living.stdout is not None
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
