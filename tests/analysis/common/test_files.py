"""Files are there whole or not at all, and nothing else is left."""

from __future__ import annotations

import os
import re
import resource
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from msg_analysis.common.files import write_whole

WRITE = """
import sys
from pathlib import Path
from msg_analysis.common.files import write_whole
write_whole(Path(sys.argv[1]), bytes(10**5))
"""


def _little_room() -> None:
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))


def test_no_room(tmp_path: Path) -> None:
    """The write itself fails: what was there stays, and of the rest nothing is left."""
    file = tmp_path / "file"
    file.write_bytes(b"before")
    process = subprocess.run(
        [sys.executable, "-B", "-c", WRITE, file], capture_output=True, text=True, preexec_fn=_little_room, check=False
    )
    assert "File too large" in process.stderr
    assert file.read_bytes() == b"before"
    assert list(tmp_path.iterdir()) == [file]


def test_a_file_like_any_other(tmp_path: Path) -> None:
    """Replaced, and with the permissions that the user's mask gives."""
    file = tmp_path / "file"
    file.write_bytes(b"before")
    mask = os.umask(0o027)
    try:
        assert write_whole(file, b"after") == file
    finally:
        os.umask(mask)
    assert (file.read_bytes(), file.stat().st_mode & 0o777) == (b"after", 0o640)
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.parametrize("words", [["msg-analysis", "simulate"], ["msg-agents", "run"]])
def test_a_place_that_is_not_utf8(words: list[str], tmp_path: Path) -> None:
    """One error that names it, before anything starts; nothing is made."""
    if words[0] == "msg-agents":
        pytest.importorskip("rclpy")
    experiment = Path(__file__).parents[2] / "data/golden/line_ring.yaml"
    command = [Path(sys.executable).with_name(words[0]), words[1], experiment, "--out", bytes(tmp_path) + b"/\xff"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (2, "")
    assert re.fullmatch(r"error: .*\\udcff: not UTF-8: choose a name in UTF-8\n", done.stderr)
    assert list(tmp_path.iterdir()) == []
