"""The files by which a run is asked to end early."""

from __future__ import annotations

import uuid
from pathlib import Path

from msg_agents.recovery import StopFiles


def test_a_request_and_its_answer_outlive_processes(tmp_path: Path) -> None:
    run, other = uuid.UUID(int=1), uuid.UUID(int=2)
    asking = StopFiles(tmp_path, run)
    assert not asking.asked()
    assert asking.decided() is None
    asking.ask()
    asking.ask()
    StopFiles(tmp_path, run).decide(1234)
    for files in (asking, StopFiles(tmp_path, run)):
        assert (files.asked(), files.decided()) == (True, 1234)
    assert (StopFiles(tmp_path, other).asked(), StopFiles(tmp_path, other).decided()) == (False, None)
    assert not list(tmp_path.glob("*.draft"))
