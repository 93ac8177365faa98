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

"""The examples that are installed with this package, and the rule by which all commands find an experiment."""

from __future__ import annotations

import os
from pathlib import Path

from msg_analysis.errors import InputError

FOLDER = Path(__file__).parent / "experiments"
SUFFIX = ".yaml"


def names() -> list[str]:
    """Names of all examples, sorted."""
    return sorted(file.stem for file in FOLDER.glob(f"*{SUFFIX}"))


def text_of(name: str) -> str:
    """The file of an example; InputError: there is none of this name."""
    if name not in names():
        raise InputError(f"{name}: no example of this name: expected one of {', '.join(names())}")
    return (FOLDER / f"{name}{SUFFIX}").read_text(encoding="utf-8")


def shows(name: str) -> str:
    """What an example shows: the first sentence of the comment at its top."""
    comment = []
    for line in text_of(name).splitlines():
        if not line.startswith("#"):
            break
        comment.append(line.removeprefix("#").strip())
    first, _, _ = " ".join(comment).partition(". ")
    return first.rstrip(".")


def find(given: str | Path, folder: Path = Path()) -> Path:
    """The file of an experiment: ``given``, relative to ``folder``, or the example of this name.

    A file wins over an example, also ``given`` with the ending .yaml. What has a slash or an ending is a path, which
    is not checked here. InputError: neither file nor example.
    """
    word = str(given)
    path = folder / word
    if os.sep in word or (path.exists() and not path.is_dir()):
        return path
    if path.suffix:
        if path.suffix == SUFFIX and path.stem in names():
            raise InputError(f"{path}: no such file: check the path, or give {path.stem}, the example of this name")
        return path
    if (own := path.with_name(f"{word}{SUFFIX}")).is_file():
        return own
    if word in names():
        return FOLDER / f"{word}{SUFFIX}"
    if path.is_dir() or word == "":
        return path
    raise InputError(
        f"{word}: no such file, and no example of this name: expected a file, or one of {', '.join(names())}"
    )
