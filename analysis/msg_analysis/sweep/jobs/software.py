"""Which software a result was made with, so that results of different versions are not taken for one sweep."""

from __future__ import annotations

import functools
import hashlib
import importlib.util
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from msg_analysis.common.version import __version__
from msg_analysis.errors import InputError

_ROOMS = ("model", "theory", "twin", "inference")


_LIBRARIES = ("distributed", "pyarrow")


def require_libraries() -> None:
    """InputError that names the libraries that only sweeps need and that are not installed."""
    missing = [name for name in _LIBRARIES if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError(
            f"{' and '.join(missing)}: not installed: sweeps need them: pip install dask {' '.join(missing)}"
        )


@functools.cache
def installed() -> str:
    """Versions of msg_analysis, numpy and scipy in one line, with a digest of the code that results depend on.

    The digest covers ``model``, ``theory``, ``inference``, the twin and ``sweep/point.py``.
    """
    source = Path(__file__).parents[2]
    files = [file for room in _ROOMS for file in (source / room).rglob("*.*") if file.suffix in (".py", ".c")]
    digest = hashlib.sha256()
    for file in sorted([*files, source / "sweep/jobs/evaluate.py"]):
        digest.update(file.read_bytes())
    libraries = " ".join(f"{name} {_version(name)}" for name in ("numpy", "scipy"))
    return f"msg_analysis {__version__} ({digest.hexdigest()[:10]}), {libraries}"


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "unknown"
