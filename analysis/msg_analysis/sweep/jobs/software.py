# Copyright 2026 msg_agents maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Which software a result was made with, so that results of different versions are not taken for one sweep."""

from __future__ import annotations

import functools
import hashlib
import importlib.util
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from msg_analysis.common.version import __version__
from msg_analysis.errors import InputError

# What the result of a job depends on: the folders and modules that ``evaluate`` imports.
_SOURCES = ("common", "model", "theory", "twin", "inference", "sweep/jobs", "errors.py", "protocol.py", "types.py")
_LIBRARIES = ("distributed", "pyarrow")


def require_libraries() -> None:
    """InputError that names the libraries that only sweeps need and that are not installed."""
    missing = [name for name in _LIBRARIES if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError(
            f"{' and '.join(missing)}: not installed: sweeps need them: pip install dask {' '.join(missing)}"
        )


@functools.cache
def installed_software() -> str:
    """Versions of msg_analysis, numpy and scipy in one line, with a digest of the code that results depend on."""
    libraries = " ".join(f"{name} {_version(name)}" for name in ("numpy", "scipy"))
    return f"msg_analysis {__version__} ({source_digest(Path(__file__).parents[2])}), {libraries}"


def source_digest(package: Path) -> str:
    """Digest of the files in the folder of msg_analysis that results depend on."""
    digest = hashlib.sha256()
    for file in source_files(package):
        digest.update(f"{file.relative_to(package)}\0".encode() + file.read_bytes())
    return digest.hexdigest()[:10]


def source_files(package: Path) -> list[Path]:
    """These files: Python and C, in order."""
    found = [file for name in _SOURCES for file in [package / name, *(package / name).rglob("*")]]
    return sorted(file for file in found if file.suffix in (".py", ".c") and file.is_file())


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "unknown"
