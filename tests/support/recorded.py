"""What is in a recorded file, by MCAP's own reader."""

from collections import defaultdict
from pathlib import Path

from mcap.reader import make_reader


def contents(*files: Path) -> dict[str, list[bytes]]:
    """The messages of each topic, in the order of the file."""
    found = defaultdict(list)
    for file in files:
        with file.open("rb") as stream:
            for _, channel, message in make_reader(stream, validate_crcs=True).iter_messages(log_time_order=False):
                found[channel.topic].append(message.data)
    return dict(found)


def texts(messages: list[bytes]) -> list[bytes]:
    """Without the bytes that middleware adds at the end, up to a multiple of four."""
    return [message.rstrip(b"\0") for message in messages]


def mcap(bag: Path) -> Path:
    """The only file of a bag."""
    (file,) = bag.glob("*.mcap")
    return Path(file)
