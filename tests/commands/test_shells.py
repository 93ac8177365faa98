"""Shells in which people start commands: limits, a folder that is gone, empty texts, settings of matplotlib."""

import errno
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from msg_agents.cli.main import main as agents_main
from msg_agents.recovery import Takeover
from msg_agents.run.folder import make_bag_directory, temporary_directory
from msg_agents.terminal import Interruption
from msg_analysis import Experiment
from msg_analysis.bags.writing import recording_pid
from msg_analysis.cli.console import CommandGroup
from msg_analysis.cli.main import main as analysis_main
from msg_analysis.sweeps.results import ResultStore

PROGRAMS = {
    "msg-agents": "from msg_agents.cli.entry_points import msg_agents as start",
    "msg-analysis": "from msg_analysis.cli.entry_point import msg_analysis as start",
}


def executed(before: str, program: str, *words: str, **how: Any) -> tuple[int, str, str]:
    """Exit code and output of a command in a process that has first run some lines."""
    code = f"import os, resource, sys\n{before}\n{PROGRAMS[program]}\nsys.argv[0] = '{program}'\nstart()"
    done = subprocess.run(
        [sys.executable, "-P", "-c", code, *words], capture_output=True, text=True, timeout=120, check=False, **how
    )
    return done.returncode, done.stdout, done.stderr


@pytest.mark.parametrize(
    ("before", "command", "words"),
    [
        ("os.rmdir(os.getcwd())", "msg-analysis simulate line_ring", "the working directory has been deleted"),
        ("os.rmdir(os.getcwd())", "msg-agents run line_ring", "the working directory has been deleted"),
        ("resource.setrlimit(resource.RLIMIT_NOFILE, (12, 12))", "msg-agents run line_ring", "too many open files"),
        ("resource.setrlimit(resource.RLIMIT_AS, (256_000_000,) * 2)", "msg-agents run line_ring", "out of memory"),
        ("resource.setrlimit(resource.RLIMIT_AS, (256_000_000,) * 2)", "msg-analysis predict x", "out of memory"),
    ],
)
def test_what_the_shell_does_not_have_is_one_error(before: str, command: str, words: str, tmp_path: Path) -> None:
    code, out, errors = executed(before, *command.split(), cwd=tmp_path)
    assert (code, out, errors.count("\n")) == (2, "", 1)
    assert errors.startswith(f"error: {words}")


@pytest.mark.parametrize("group", [analysis_main, agents_main], ids=["msg-analysis", "msg-agents"])
@pytest.mark.parametrize("word", ["", ".", "..", "/"])
def test_what_is_no_file_of_an_experiment(group: CommandGroup, word: str) -> None:
    done = CliRunner().invoke(group, ["predict" if group is analysis_main else "run", word])
    assert done.exit_code == 2
    assert "an empty text: expected a path" in done.stderr or f"error: {word}: is a directory" in done.stderr


@pytest.mark.parametrize("error", [ValueError("x"), RuntimeError("x"), KeyError("x"), OSError("x"), RecursionError()])
def test_a_fault_of_the_program_is_no_verdict(error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    """Exit code 70 of sysexits.h, where 1 means "disagrees"; the traceback is for the report."""

    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr("msg_analysis.cli.main.load_experiment", fail)
    done = CliRunner().invoke(analysis_main, ["predict", "line_ring"])
    assert (done.exit_code, done.stdout) == (70, "")
    words, _, traceback = done.stderr.partition("Traceback")
    assert words == "error: a fault of this program: please report it, with the lines below and the command\n"
    assert type(error).__name__ in traceback.splitlines()[-1]


def test_figures_do_not_depend_on_settings_of_matplotlib(tmp_path: Path) -> None:
    """A kernel of Jupyter sets a backend that is not there; in a folder there may be a matplotlibrc. Not so here."""
    (tmp_path / "matplotlibrc").write_text("text.usetex: True\nfont.size: 20\nsavefig.dpi: 30\n")
    command, environment = ("spectrum", "line_ring", "--figure"), os.environ | {"MPLBACKEND": "module://not_there"}
    code, _, errors = executed("", "msg-analysis", *command, "other.png", cwd=tmp_path, env=environment)
    assert code == 0, errors
    assert CliRunner().invoke(analysis_main, [*command, str(tmp_path / "here.png")]).exit_code == 0
    assert (tmp_path / "other.png").read_bytes() == (tmp_path / "here.png").read_bytes()


@pytest.mark.parametrize("name", ["r\udcff.html", "\udce9/r.html"])
def test_the_name_of_a_report_is_text(name: str, tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    assert (
        CliRunner().invoke(analysis_main, ["simulate", "line_ring", "--duration", "5", "--out", str(bag)]).exit_code
        == 0
    )
    (tmp_path / "\udce9").mkdir()
    done = CliRunner().invoke(analysis_main, ["compare", str(bag), "--report", str(tmp_path / name)])
    assert (done.exit_code, done.stdout) == (2, "")
    assert "not UTF-8: choose a name in UTF-8" in done.stderr


def test_in_other_threads_signals_are_left_to_the_main_one() -> None:
    """As in a run that asyncio.to_thread starts: only the main thread can handle signals."""
    found: list[int | None] = []

    def work() -> None:
        with Interruption() as interruption, interruption.let_through():
            found.append(interruption.take())

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert found == [None]


@pytest.mark.parametrize("reason", [errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP])
@pytest.mark.parametrize(
    "use",
    [
        lambda folder: make_bag_directory(Experiment.load("line_ring"), folder),
        lambda folder: Experiment.load("line_ring").simulate(duration=5).save(folder / "bag"),
        lambda folder: Takeover(folder / "agent_1"),
    ],
    ids=["run", "bag", "agent"],
)
def test_file_systems_without_locks(
    use: Callable[[Path], object],
    reason: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Lustre without -o flock, NFS without its daemon, FUSE: work goes on, with one note for all that is locked."""

    def refuse(*_: object) -> None:
        raise OSError(reason, os.strerror(reason))

    monkeypatch.setattr("fcntl.flock", refuse)
    monkeypatch.setattr("msg_analysis.common.files._without_locks", [])
    use(tmp_path)
    with ResultStore.open(tmp_path / "sweep") as store, temporary_directory() as folder:
        assert folder.is_dir()
        assert store.damaged == 0
    errors = capsys.readouterr().err
    assert errors.count("note:") == errors.count("\n") == 1
    assert f"its file system has no locks ({os.strerror(reason)})" in errors
    assert recording_pid(tmp_path / "bag") is None
