"""The options of every command that writes a bag."""

from __future__ import annotations

from collections.abc import Callable

import click

from msg_analysis.bags.format.storage_options import COMPRESSIONS, DEFAULT, MEGABYTE, Compression, Storage
from msg_analysis.errors import InputError

SMALLEST_SPLIT = 0.1  # MB; of the order of a chunk


def storage_options(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command the arguments ``compression`` and ``split_size`` [MB]; see :func:`storage`.

    Parameters
    ----------
    command
        function of the command, below ``click.command``
    """
    for option in (
        click.option(
            "--compression",
            type=click.Choice(COMPRESSIONS),
            default=DEFAULT.compression,
            help="Of the bag, chunk by chunk.",
        ),
        click.option(
            "--split-size",
            type=click.FloatRange(SMALLEST_SPLIT),
            metavar="MB",
            help="Go on in a new file of the bag after so many MB (10^6 bytes).",
        ),
    ):
        command = option(command)
    return command


def storage(compression: Compression, split_size: float | None) -> Storage:
    """What these options say.

    Parameters
    ----------
    compression
        of the chunks
    split_size
        of a file of the bag [MB, 10^6 bytes]; None: one file

    Raises
    ------
    InputError
        no size
    """
    try:
        size = None if split_size is None else round(split_size * MEGABYTE)
    except (ValueError, OverflowError) as error:  # nan, inf
        raise InputError(f"--split-size: {split_size}: expected a number of MB") from error
    return Storage(compression, size)
