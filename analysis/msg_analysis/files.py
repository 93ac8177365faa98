"""Writing files so that they are never there in part."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path


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
        stream.write(content)
    try:
        mask = os.umask(0)
        os.umask(mask)
        temporary.chmod(0o666 & ~mask)
        temporary.replace(path)
    except OSError:
        temporary.unlink()
        raise
    return path
