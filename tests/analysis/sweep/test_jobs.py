"""How a worker of a sweep runs ``msg-agents``, what is kept of its jobs, and of which software they are."""

import dataclasses
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import msg_analysis
from msg_analysis.errors import InputError
from msg_analysis.sweeps.points import (
    DONE,
    Job,
    NetworkOptions,
    NetworkStoppedError,
    Outcome,
    run_network,
    source_digest,
    source_files,
)
from msg_analysis.sweeps.results import JOURNAL, ResultStore

DOCUMENT = {"name": "two", "graphs": {"link": {"path": [1, 2]}}}


def job(directory: Path, script: str, *, keep: bool = False) -> Job:
    """A job whose program is a shell script: its arguments are run FILE --out DIR --write-report WHEN --json."""
    program = directory / "msg-agents"
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(0o755)
    made = Job.of("network", DOCUMENT)
    return dataclasses.replace(made, network=NetworkOptions(str(program), str(directory / "runs"), keep))


SAY = 'printf \'{"verdict": "%s", "bag": "%s", "report": "%s", "experiment": %s}\' $VERDICT "$4" "$6" "$(cat $2)"'


@pytest.mark.parametrize(
    ("verdict", "keep", "report", "kept"),
    [
        ("agrees", False, "on-failure", False),
        ("agrees", True, "always", True),
        ("disagrees", False, "on-failure", True),
    ],
)
def test_what_is_run_and_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, verdict: str, keep: bool, report: str, kept: bool
) -> None:
    monkeypatch.setenv("VERDICT", verdict)
    document = run_network(job(tmp_path, SAY, keep=keep), lambda: False)
    assert document["experiment"] == DOCUMENT
    assert document["report"] == report
    assert (document["bag"] is not None) == kept
    assert any((tmp_path / "runs").iterdir()) == kept


def test_a_run_that_fails(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"msg-agents run: exit code 7: no room$"):
        run_network(job(tmp_path, "echo first >&2; echo error: no room >&2; exit 7"), lambda: False)
    assert list((tmp_path / "runs").iterdir()) == []


def test_a_run_that_is_stopped(tmp_path: Path) -> None:
    """It gets an interrupt, as by Ctrl-C, and time to end."""
    script = f"trap 'echo ended > {tmp_path}/trace; exit 3' INT; touch {tmp_path}/begun; while :; do sleep 0.05; done"
    with pytest.raises(NetworkStoppedError):
        run_network(job(tmp_path, script), (tmp_path / "begun").exists)
    assert (tmp_path / "trace").read_text() == "ended\n"
    assert list((tmp_path / "runs").iterdir()) == []


def outcome(name: str, value: float = 1.0) -> Outcome:
    return Outcome(name, DONE, None, {"system_error": value}, 0.1, "here:1", "version 1")


def test_cut_anywhere_it_keeps_all_whole_lines_and_goes_on(tmp_path: Path) -> None:
    """Of two outcomes of a job, the last."""
    with ResultStore.open(tmp_path / "new") as store:
        store.add([outcome("a", 2.0), outcome("b", float("inf")), outcome("a")])
    with ResultStore.open(tmp_path / "new") as store:
        assert store.outcomes == {"a": outcome("a"), "b": outcome("b", float("inf"))}
    with ResultStore.open(tmp_path) as store:
        store.add([outcome("a"), outcome("b")])
    content = (tmp_path / JOURNAL).read_bytes()
    for size in range(len(content) + 1):
        (tmp_path / JOURNAL).write_bytes(content[:size])
        whole = ["a", "b"][: content[:size].count(b"\n")]
        with ResultStore.open(tmp_path) as store:
            assert list(store.outcomes) == whole
            assert store.damaged == 0
            store.add([outcome("d")])
        with ResultStore.open(tmp_path) as store:
            assert list(store.outcomes) == [*whole, "d"]
            assert store.damaged == 0


@pytest.mark.parametrize("line", [b"{}", b"nonsense", b"\xff\xfe", b"[1]", b""])
def test_lines_that_are_none_are_counted(tmp_path: Path, line: bytes) -> None:
    with ResultStore.open(tmp_path) as store:
        store.add([outcome("a")])
    path = tmp_path / JOURNAL
    path.write_bytes(line + b"\n" + path.read_bytes())
    with ResultStore.open(tmp_path) as store:
        assert list(store.outcomes) == ["a"]
        assert store.damaged == 1


def test_one_writer_at_a_time(tmp_path: Path) -> None:
    code = f"from msg_analysis.sweeps.results import ResultStore; ResultStore.open({str(tmp_path)!r})"
    with ResultStore.open(tmp_path):
        with pytest.raises(InputError, match="another sweep is writing"):
            ResultStore.open(tmp_path)
        other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
        assert "another sweep is writing" in other.stderr
    ResultStore.open(tmp_path).close()


def test_a_place_that_cannot_be(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="choose another place with --out"):
        ResultStore.open(tmp_path / "file")


PACKAGE = Path(msg_analysis.__file__).parent
IMPORTED = """
import sys
from msg_analysis.sweeps.points import evaluate
from msg_analysis.theory import prediction
from msg_analysis.inference.verdict import compare_run
from msg_analysis.twin import simulate
print(*(module.__file__ for name, module in sys.modules.items() if name.startswith("msg_analysis.")), sep="\\n")
"""


def test_the_digest_covers_every_module_that_a_job_imports() -> None:
    listed = subprocess.run([sys.executable, "-c", IMPORTED], capture_output=True, check=True, text=True).stdout
    imported = {Path(line) for line in listed.splitlines() if line.endswith(".py")} - {PACKAGE / "sweeps/__init__.py"}
    assert len(imported) > 60
    assert imported <= set(source_files(PACKAGE))


def test_the_digest_changes_with_every_one_of_its_files_and_no_other(tmp_path: Path) -> None:
    copy = tmp_path / "msg_analysis"
    shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    (copy / "report/tables.py").write_text("")
    (copy / "model/notes.txt").write_text("")
    assert source_digest(copy) == source_digest(PACKAGE)
    digests = {source_digest(copy)}
    files = source_files(copy)
    for file in files:
        with file.open("a") as stream:
            stream.write("\n")
        digests.add(source_digest(copy))
    assert len(digests) == len(files) + 1
