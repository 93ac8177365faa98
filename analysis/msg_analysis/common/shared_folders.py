# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""What is kept in folders to which every user of the machine can write, such as /tmp: all of it below one of our own.

There, nobody else can have put a file, a pipe or a link under a name that a program is about to use.
"""

from __future__ import annotations

import fcntl
import functools
import os
import shutil
import stat
import tempfile
import time
from contextlib import suppress
from itertools import islice
from pathlib import Path

PRIVATE = 0o700
MOST_CLEARED = 100  # folders, each time


def own_folder(parent: Path | None = None) -> Path:
    """The folder of this user in ``parent`` (None: the temporary directory), made if needed."""
    # XDG_RUNTIME_DIR goes when the user logs out, though a sweep with nohup goes on; and not every session has it.
    user = os.geteuid()
    folder = (parent or Path(tempfile.gettempdir())) / f"msg_agents-{user}"
    with suppress(FileExistsError):
        folder.mkdir(PRIVATE)
    found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != user:
        return _replacement(folder.parent)
    if stat.S_IMODE(found.st_mode) != PRIVATE:  # by an unusual umask, for example
        folder.chmod(PRIVATE)
    return folder


@functools.cache
def _replacement(parent: Path) -> Path:
    """One of this process alone, where somebody else has taken the name: nobody can keep us from working."""
    return Path(tempfile.mkdtemp(prefix="msg_agents-", dir=parent))


def clear_unlocked(folder: Path, prefix: str, youth: float, most: int = MOST_CLEARED) -> None:
    """Remove some folders with names of this kind that nobody has locked, and that are older than ``youth`` [s]."""
    with os.scandir(folder) as entries:
        found = [Path(entry) for entry in islice((each for each in entries if each.name.startswith(prefix)), most)]
    for path in found:
        with suppress(OSError, RecursionError):  # gone already, or locked; nested too deeply for Python
            if time.time() - path.stat().st_mtime < youth:
                continue
            descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(path)
            finally:
                os.close(descriptor)
