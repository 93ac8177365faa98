"""Folders that every user can write to: what others have put there does no harm, whatever it is."""

import os
import shutil
import stat
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from msg_analysis.common import shared_folders
from msg_analysis.common.shared_folders import clear_unlocked, own_folder

OLD = 1e9  # s since 1970


@pytest.fixture
def shared(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """As /tmp is; pytest's own directories are closed to others."""
    folder = Path(tempfile.mkdtemp(dir="/tmp"))
    folder.chmod(0o1777)
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    shared_folders._replacement.cache_clear()
    yield folder
    shutil.rmtree(folder)


def as_user(user: int, do: Callable[[], bool]) -> bool:
    """What another process of this user finds."""
    pid = os.fork()
    if pid == 0:
        code = 1
        with suppress(BaseException):
            if user != os.geteuid():
                os.setgid(user)
                os.setuid(user)
            code = 0 if do() else 2
        os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0


def is_private(folder: Path) -> bool:
    found = folder.lstat()
    return (stat.filemode(found.st_mode), found.st_uid) == ("drwx------", os.geteuid())


@pytest.mark.parametrize("umask", [0, 0o022, 0o077, 0o777])
def test_one_folder_of_the_user(shared: Path, umask: int) -> None:
    before = os.umask(umask)
    try:
        folder = own_folder()
    finally:
        os.umask(before)
    assert folder == own_folder() == shared / f"msg_agents-{os.geteuid()}"
    assert is_private(folder)
    folder.chmod(0o777)
    assert is_private(own_folder())


@pytest.mark.parametrize("kind", ["file", "pipe", "link", "loop"])
def test_what_is_there_under_its_name(shared: Path, kind: str) -> None:
    """Is not opened, followed or changed: another folder takes its place, the same one as long as the process lives."""
    place, elsewhere = shared / f"msg_agents-{os.geteuid()}", shared / "elsewhere"
    elsewhere.mkdir(0o755)
    match kind:
        case "file":
            place.touch()
        case "pipe":
            os.mkfifo(place)
        case "link":
            place.symlink_to(elsewhere)
        case _:
            place.symlink_to(place)
    before = place.lstat()
    folder = own_folder()
    assert folder == own_folder() != place
    assert is_private(folder)
    assert place.lstat() == before
    assert stat.filemode(elsewhere.stat().st_mode) == "drwxr-xr-x"


@pytest.mark.skipif(os.geteuid() != 0, reason="run as root: two users")
def test_two_users(shared: Path) -> None:
    """Each has a folder, into which the other cannot write, and one that the other has made is not used."""
    one, two = 65533, 65534
    assert as_user(one, lambda: own_folder() == shared / "msg_agents-65533" and is_private(own_folder()))
    assert not as_user(two, lambda: bool((shared / "msg_agents-65533" / "x").write_text("x")))
    assert as_user(one, lambda: (shared / "msg_agents-65534").mkdir(0o777) is None)
    assert as_user(two, lambda: own_folder() != shared / "msg_agents-65534" and is_private(own_folder()))


def test_clearing_is_bounded(tmp_path: Path) -> None:
    """Some folders of a great many each time; what is nested too deeply for Python stops nothing."""
    for number in range(30):
        (tmp_path / f"run_{number}").mkdir()
        os.utime(tmp_path / f"run_{number}", (OLD, OLD))
    (tmp_path / "other").mkdir()
    clear_unlocked(tmp_path, "run_", 60.0, most=20)
    assert len(list(tmp_path.iterdir())) == 11
    clear_unlocked(tmp_path, "run_", time.time() - OLD + 60.0)  # all are younger than that
    assert len(list(tmp_path.iterdir())) == 11
    (tmp_path / "other").rename(tmp_path / "run_deep")
    here = os.open(tmp_path / "run_deep", os.O_RDONLY)
    for _ in range(sys.getrecursionlimit()):
        os.mkdir("x", dir_fd=here)
        inner = os.open("x", os.O_RDONLY, dir_fd=here)
        os.close(here)
        here = inner
    os.utime(tmp_path / "run_deep", (OLD, OLD))
    clear_unlocked(tmp_path, "run_", 60.0)
    assert [path.name for path in tmp_path.iterdir()] == ["run_deep"]
    for _ in range(sys.getrecursionlimit()):  # pytest could not remove it
        outer = os.open("..", os.O_RDONLY, dir_fd=here)
        os.close(here)
        here = outer
        os.rmdir("x", dir_fd=here)
    os.close(here)
