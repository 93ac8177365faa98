"""A recorder that stands still, and a disk that is full."""

from __future__ import annotations

import random
import re
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from msg_analysis.bags.reading import read_bag
from msg_analysis.twin.check import check

PAUSE = 10.0  # s


@pytest.mark.timeout(150)
def test_stopped_recorder(network: Any, repetition: int, rng: random.Random) -> None:
    """At full speed everybody waits for it in the end, and nothing is lost."""
    file = network.file(run={"duration": 400, "processes": 2})
    run = network.record(file, "--json")
    network.wait_for_steps()
    time.sleep(rng.uniform(0.0, 1.0))
    (recorder,) = network.processes("recorder")
    recorder.kill(signal.SIGSTOP)
    time.sleep(PAUSE)
    recorder.kill(signal.SIGCONT)
    assert network.completed(run)["restarts"] == []


@pytest.fixture
def small_disk(tmp_path: Path, rng: random.Random) -> Iterator[Path]:
    """A file system of its own, of about 1 MB."""
    disk = tmp_path / "disk"
    disk.mkdir()
    size = f"size={rng.randrange(700, 1300)}k"
    mount = subprocess.run(["mount", "-t", "tmpfs", "-o", size, "none", disk], capture_output=True, check=False)
    if mount.returncode:
        pytest.skip("run as root: only root can mount a small file system")
    try:
        yield disk
    finally:
        subprocess.run(["umount", "--lazy", disk], check=True)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_full_disk(network: Any, small_disk: Path, repetition: int) -> None:
    """The run ends, says why, and what was written can be read."""
    # 20,000 steps, of states that fill it in some 2,000.
    file = network.file(run={"duration": 1000, "replicas": 8, "processes": 2})
    run = network.start("run", file, "--out", small_disk)
    _, stderr = run.communicate(timeout=120)
    assert run.returncode == 3, stderr
    assert "Traceback" not in stderr
    assert re.search(r"^failed: recorder: .*No space left on device", stderr, re.MULTILINE), stderr
    assert network.processes() == []
    (bag,) = (path for path in small_disk.iterdir() if path.is_dir())
    trajectory = read_bag(bag)
    assert trajectory.completeness.received > 1000
    assert check(trajectory).difference is None
