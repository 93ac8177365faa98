"""Real processes which hang where only C code runs."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from msg_agents.nodes.base import exit_after

HANGS = "ctypes.PyDLL(None).pause()"  # with the interpreter's lock held
BEGIN = f"import atexit, ctypes, sys, time; from {exit_after.__module__} import exit_after; print('done');"

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="this machine: its C library has no such timers")


@pytest.mark.parametrize(
    ("code", "exit_code"),
    [
        (f"exit_after(1); {HANGS}", 0),
        (f"exit_after(1); atexit.register(lambda: {HANGS})", 0),
        ("exit_after(1); time.sleep(60); sys.exit(3)", 0),
        ("exit_after(60); sys.exit(3)", 3),
        (f"sys.stderr = None; exit_after(1); {HANGS}", 0),
    ],
    ids=["hangs with the lock held", "hangs while the interpreter ends", "works too long", "ends in time", "no stream"],
)
def test_exit_after(code: str, exit_code: int) -> None:
    """What was printed before is not lost."""
    result = subprocess.run([sys.executable, "-c", f"{BEGIN} {code}"], stdout=subprocess.PIPE, text=True, check=False)
    assert (result.returncode, result.stdout) == (exit_code, "done\n")


def test_nobody_reads_what_was_printed() -> None:
    """The pipe is broken when the buffer is written: the process ends as it would have."""
    code = f"{BEGIN} sys.stdin.read(); exit_after(1); {HANGS}"
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    buffered = os.environ | {"PYTHONUNBUFFERED": ""}
    with subprocess.Popen([sys.executable, "-c", code], env=buffered, **pipes) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        process.stdin.close()
        assert (process.stderr.read(), process.wait()) == (b"", 0)
