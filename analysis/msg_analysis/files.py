"""Places of files that are written at the end of long work."""

from __future__ import annotations

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
