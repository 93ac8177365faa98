"""What a process needs to take over from a killed one."""

import errno
import mmap
import multiprocessing
import os
import signal
import subprocess
import sys
import uuid
from pathlib import Path

import pytest
from waiting import wait_for

pytest.importorskip("rclpy")

from msg_agents.recovery import FOOTER, LEAST_STATES, Checkpoint, StopFiles, take_over
from msg_analysis.errors import InputError

LARGE = 100_000  # bytes of a message, so that the ring has its least length


def message(step: int, size: int = LARGE) -> bytes:
    return step.to_bytes(8, "little") * (size // 8)


@pytest.mark.parametrize("steps", [0, 1, 5, LEAST_STATES - 1, LEAST_STATES, LEAST_STATES + 1, 3 * LEAST_STATES + 7])
def test_the_newest_are_kept(tmp_path: Path, steps: int) -> None:
    written = Checkpoint(tmp_path / "states", LARGE)
    for step in range(steps):
        written.write(step, message(step))
    kept = range(max(0, steps - LEAST_STATES + 1), steps)
    for ring in (written, Checkpoint(tmp_path / "states", LARGE)):
        assert ring.read() == [(step, message(step)) for step in kept]
        assert [step for step, _ in ring.read(steps - 3)] == [step for step in kept if step >= steps - 3]
        assert ring.read(steps) == []


def test_messages_of_different_length(tmp_path: Path) -> None:
    """With lost messages, some list what was heard."""
    ring = Checkpoint(tmp_path / "states", LARGE)
    for step in range(LEAST_STATES + 5):
        ring.write(step, message(step, LARGE - 8 * (step % 3)))
    for again in (ring, Checkpoint(tmp_path / "states", LARGE)):
        assert all(data == message(step, LARGE - 8 * (step % 3)) for step, data in again.read())
        assert len(again.read()) == LEAST_STATES - 1


def test_in_memory() -> None:
    ring = Checkpoint(None, 24)
    ring.write(0, message(0, 24))
    assert ring.read() == [(0, message(0, 24))]
    assert not ring.found


def test_another_size_is_another_run(tmp_path: Path) -> None:
    assert [Checkpoint(tmp_path / "states", 200).found for _ in range(2)] == [False, True]
    with pytest.raises(InputError, match=r"expected .* another run"):
        Checkpoint(tmp_path / "states", 208)


WRITERS = """
import os, sys
from pathlib import Path
from msg_agents.recovery import Checkpoint
for file in sys.argv[1:]:
    writer = os.fork()
    if writer:
        print("ended by", os.WTERMSIG(os.waitpid(writer, 0)[1]), flush=True)
        continue
    ring = Checkpoint(Path(file), 8000)
    for step in range(10**9):
        ring.write(step, step.to_bytes(8, "little") * 1000)
        if step == 5000:
            print(os.getpid(), flush=True)
"""


def test_killed_in_the_middle_of_it(tmp_path: Path) -> None:
    """Whenever it happens, what is read is whole and without a gap."""
    files = [tmp_path / f"states_{attempt}" for attempt in range(10)]
    command = [sys.executable, "-P", "-c", WRITERS, *map(str, files)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        for _ in files:
            os.kill(int(process.stdout.readline()), signal.SIGKILL)
            assert process.stdout.readline() == f"ended by {signal.SIGKILL:d}\n"
    for file in files:
        found = Checkpoint(file, 8000).read()
        steps = [step for step, _ in found]
        assert steps == list(range(steps[0], steps[0] + len(steps)))
        assert len(steps) > 1000
        assert all(data == step.to_bytes(8, "little") * 1000 for step, data in found)


def test_read_while_it_is_written(tmp_path: Path) -> None:
    """By another process, as the live panel does: a step whose footer is the same before and after is whole."""
    code = (
        "import sys; from pathlib import Path; from msg_agents.recovery import Checkpoint\n"
        f"ring, step = Checkpoint(Path(sys.argv[1]), {LARGE}), 0\n"
        f"while True: ring.write(step, step.to_bytes(8, 'little') * ({LARGE} // 8)); step += 1"
    )
    file, slot = tmp_path / "states", LARGE + FOOTER.size
    writer = subprocess.Popen([sys.executable, "-P", "-c", code, str(file)])
    try:
        wait_for(lambda: file.exists() and file.stat().st_size == LEAST_STATES * slot)
        with file.open("rb") as stream:
            ring = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
        whole = []
        for number in range(40_000):
            start = number % LEAST_STATES * slot
            before = FOOTER.unpack_from(ring, start + LARGE)
            found = ring[start : start + LARGE]
            if before[1] and FOOTER.unpack_from(ring, start + LARGE) == before:
                whole.append(found == message(before[1] - 1))
        assert all(whole)
        assert len(whole) > 1000
    finally:
        writer.kill()
        writer.wait()


def test_no_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Said at once: who writes to a map without room behind it is killed by SIGBUS."""

    def full(*_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(InputError, match=r"no room for \d+ bytes \(No space left on device\).*--restarts 0"):
        Checkpoint(tmp_path / "states", LARGE)


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


PREFIX = bytes(range(1, 13))


def run_and_die(directory: Path) -> None:
    (own,) = take_over(directory, ["agent_1"])
    own.store_prefix(PREFIX)
    os.kill(os.getpid(), 9)


def test_a_takeover_removes_the_process_before_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    removed: list[tuple[bytes, int]] = []
    monkeypatch.setenv("ROS_DOMAIN_ID", "7")
    before = multiprocessing.get_context("fork").Process(target=run_and_die, args=(tmp_path,))
    before.start()
    before.join()
    assert removed == []  # there was no process before
    takeovers = take_over(tmp_path, ["agent_1", "agent_2"], lambda *what: removed.append(what))
    assert removed == [(PREFIX, 7)]
    with pytest.raises(InputError, match="another process is running agent_2"):
        take_over(tmp_path, ["agent_2"])
    assert [t.predecessor for t in takeovers] == [PREFIX, b""]
    assert take_over(None, ["agent_1"]) == []
