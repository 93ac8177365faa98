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

"""The options of every command that writes a bag."""

from __future__ import annotations

from collections.abc import Callable

import click

from msg_analysis.bags.format.storage_options import (
    COMPRESSIONS,
    DEFAULT_STORAGE,
    MEGABYTE,
    SMALLEST_SPLIT,
    Compression,
    Storage,
)
from msg_analysis.errors import InputError


def storage_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add the arguments ``compression`` and ``split_size`` [MB, 10^6 bytes] to a command; see :func:`storage`."""
    for option in (
        click.option(
            "--compression",
            type=click.Choice(COMPRESSIONS),
            default=DEFAULT_STORAGE.compression,
            help="Compression of the chunks of the bag.",
        ),
        click.option(
            "--split-size",
            type=click.FloatRange(SMALLEST_SPLIT),
            metavar="MB",
            help="Start a new file of the bag after this many MB (10^6 bytes).",
        ),
    ):
        command = option(command)
    return command


def storage(compression: Compression, split_size: float | None) -> Storage:
    """The storage that these options ask for; ``split_size`` [MB, 10^6 bytes] is None for one file."""
    try:
        size = None if split_size is None else round(split_size * MEGABYTE)
    except (ValueError, OverflowError) as error:  # nan, inf
        raise InputError(f"--split-size: {split_size}: expected a number of MB") from error
    return Storage(compression, size)
