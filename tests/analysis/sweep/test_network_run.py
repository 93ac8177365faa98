"""How a worker of a sweep runs ``msg-agents``: here, programs that are no scripts of Python, which are not forked."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from msg_analysis.errors import InputError
from msg_analysis.sweeps.points import Job, NetworkOptions, NetworkStoppedError, run_network

DOCUMENT = {"name": "two", "graphs": {"link": {"path": [1, 2]}}}


def job(directory: Path, script: str, *, keep: bool = False) -> Job:
    """A job whose program is a shell script: its arguments are run FILE --out DIR --write-report WHEN --json."""
    program = directory / "msg-agents"
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(0o755)
    made = Job.of("network", DOCUMENT)
    return dataclasses.replace(made, network=NetworkOptions(str(program), str(directory / "runs"), keep))


def never() -> bool:
    return False


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
    document = run_network(job(tmp_path, SAY, keep=keep), never)
    assert document["experiment"] == DOCUMENT
    assert document["report"] == report
    assert (document["bag"] is not None) == kept
    assert any((tmp_path / "runs").iterdir()) == kept


def test_a_run_that_fails(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"msg-agents run: exit code 7: no room$"):
        run_network(job(tmp_path, "echo first >&2; echo error: no room >&2; exit 7"), never)
    assert list((tmp_path / "runs").iterdir()) == []


def test_a_run_that_is_stopped(tmp_path: Path) -> None:
    """It gets an interrupt, as by Ctrl-C, and time to end."""
    script = f"trap 'echo ended > {tmp_path}/trace; exit 3' INT; touch {tmp_path}/begun; while :; do sleep 0.05; done"
    with pytest.raises(NetworkStoppedError):
        run_network(job(tmp_path, script), (tmp_path / "begun").exists)
    assert (tmp_path / "trace").read_text() == "ended\n"
    assert list((tmp_path / "runs").iterdir()) == []
