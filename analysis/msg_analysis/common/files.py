"""Files that are written at the end of long work: a place for them, and never in part."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from msg_analysis.errors import InputError


def require_place(file: Path | None) -> None:
    """Refuse a place where no file can be put, before anything is computed.

    Parameters
    ----------
    file
        to be written, whole, in place of what is there; None: nothing is

    Raises
    ------
    InputError
        its directory is not there, or what is there is no file (a device would be replaced by one)
    """
    if file is None:
        return
    if not file.parent.is_dir():
        raise InputError(f"{file}: no such directory {file.parent}: create it")
    if file.exists() and not file.is_file():
        raise InputError(f"{file}: no regular file: name another")


def write_whole(path: Path, content: bytes) -> Path:
    """Write a file under another name first, then give it its own.

    Parameters
    ----------
    path
        replaced if it is there
    content
        all of it

    Returns
    -------
    Path
        The path.

    Raises
    ------
    OSError
        it cannot be written; what was there is as it was
    """
    with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}.", delete=False) as stream:
        temporary = Path(stream.name)
        try:
            stream.write(content)
            stream.flush()  # a full disk shows here
            mask = os.umask(0)
            os.umask(mask)
            temporary.chmod(0o666 & ~mask)
            temporary.replace(path)
        except OSError:
            temporary.unlink()
            raise
    return path
