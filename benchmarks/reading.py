"""How fast a bag is read: side by side with rosbags and with mcap-ros2-support, which deserialise message by message.

The bag is a run of the twin: the five agents of the demo, line and ring, as many steps as make the number of states
asked for, in chunks as the recorder writes them. Each measurement is a process of its own, the readers take turns, and
the time counts from the opening of the bag to the last state; importing is not in it. For `read_bag` the last state is
in its place in the arrays of a Run, for the others it has been deserialised and dropped again. The ratios are
taken within a round, of the time on the clock and of CPU time, which a busy machine disturbs less; medians count.
Memory is the peak of the process, and that without the arrays of the Run.

About four minutes for 2 million states. `--only` leaves the others out, to see the memory that a large bag takes:
`--states 20000000 --only` needs 0.6 GB of disk and some ten minutes.
"""

from __future__ import annotations

import argparse
import multiprocessing
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

EXPERIMENT = Path(__file__).parents[1] / "analysis/msg_analysis/experiment/bundled/line_ring.yaml"
TOPICS = [f"/agent_{i}/state" for i in range(1, 6)]
Result = TypeVar("Result")


@dataclass(frozen=True, slots=True)
class Reading:
    """One reading: states, seconds on the clock and of CPU, peak memory and arrays of the result [bytes]."""

    states: int
    seconds: float
    cpu: float
    peak: int
    arrays: int = 0


class Stopwatch:
    """Of the clock and of the CPU time of this process."""

    def __init__(self) -> None:
        self._began = time.perf_counter(), time.process_time()

    def read(self) -> tuple[float, float]:
        """Seconds since it was made."""
        return time.perf_counter() - self._began[0], time.process_time() - self._began[1]


def make_bag(directory: Path, states: int, replicas: int) -> None:
    """A bag with at least so many states."""
    from msg_analysis.bags.writing import write_trajectory
    from msg_analysis.experiment.experiment import Experiment
    from msg_analysis.twin.simulate import simulate

    document = Experiment.load(EXPERIMENT).to_document()
    steps = -(-states // len(TOPICS)) - 1
    document["run"] |= {"duration": round(steps * document["run"]["dt"], 6), "replicas": replicas}
    write_trajectory(simulate(Experiment.parse(document)), directory)


def without_chunks(directory: Path) -> None:
    """The same bag as `ros2 bag record --storage-preset-profile fastwrite` would have it, by mcap's own writer."""
    from mcap.reader import make_reader
    from mcap.writer import IndexType, Writer

    (file,) = directory.glob("*.mcap")
    loose = file.with_suffix(".loose")
    with file.open("rb") as source, loose.open("wb") as target:
        writer = Writer(target, use_chunking=False, index_types=IndexType.NONE)
        writer.start("ros2")
        numbers: dict[int, int] = {}
        for schema, channel, message in make_reader(source).iter_messages(log_time_order=False):
            if channel.id not in numbers:
                assert schema is not None
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                numbers[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, number, channel.metadata
                )
            writer.add_message(numbers[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()
    loose.replace(file)


def read_bag(directory: Path) -> Reading:
    """The reader of this software."""
    from msg_analysis.bags.reading import read_bag as read

    watch = Stopwatch()
    trajectory = read(directory)
    seconds, cpu = watch.read()
    if not trajectory.completeness.complete:
        raise SystemExit(f"{directory}: {trajectory.completeness}")
    kept = [trajectory.states, trajectory.agent_modes, trajectory.modes]
    arrays = sum(array.nbytes for array in kept if array is not None)
    return Reading(trajectory.completeness.received, seconds, cpu, peak_memory(), arrays)


def rosbags(directory: Path) -> Reading:
    """Its AnyReader, with the definitions that are in the bag."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    typestore, states = get_typestore(Stores.ROS2_JAZZY), 0
    watch = Stopwatch()
    with AnyReader([directory], default_typestore=typestore) as reader:
        connections = [connection for connection in reader.connections if connection.topic in TOPICS]
        for connection, _, data in reader.messages(connections=connections):
            reader.deserialize(data, connection.msgtype)
            states += 1
    return Reading(states, *watch.read(), peak_memory())


def mcap(directory: Path) -> Reading:
    """The reader of mcap with the decoder of mcap-ros2-support, in the order of the file, in which it is faster."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    states = 0
    watch = Stopwatch()
    with next(directory.glob("*.mcap")).open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for _ in reader.iter_decoded_messages(topics=TOPICS, log_time_order=False):
            states += 1
    return Reading(states, *watch.read(), peak_memory())


READERS: dict[str, Callable[[Path], Reading]] = {
    "`read_bag`": read_bag,
    "rosbags": rosbags,
    "mcap-ros2-support": mcap,
}


def read_by(name: str, directory: Path) -> Reading:
    """One reading. Just before it the memory that it may need is used by somebody else, and given back.

    A virtual machine whose host takes back what lies idle spends up to 0.6 s for the first touch of 256 MB, and another
    time 0.03 s: as much as a whole reading, and nothing that a reader could do about it.
    """
    in_fresh_process(touch, 3 * 2**28)
    return in_fresh_process(READERS[name], directory)


def touch(size: int) -> None:
    """Use so much memory [bytes]."""
    np.ones(size, dtype=np.uint8)


def peak_memory() -> int:
    """Largest resident size of this process so far [bytes]."""
    (line,) = [line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM")]
    return int(line.split()[1]) * 1024


def in_fresh_process(function: Callable[..., Result], *arguments: object) -> Result:
    """What a function returns, called there."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(function, arguments)


def measure(directory: Path, rounds: int, names: list[str]) -> dict[str, list[Reading]]:
    """All readers in turn."""
    readings: dict[str, list[Reading]] = {name: [] for name in names}
    for number in range(rounds):
        for name in names:
            # What is over in a second meets a stall of the machine or does not: the middle one of three counts.
            repeated = [read_by(name, directory) for _ in range(3 if name == names[0] else 1)]
            reading = sorted(repeated, key=lambda reading: reading.seconds)[len(repeated) // 2]
            readings[name].append(reading)
            rate = reading.states / reading.seconds
            print(f"round {number + 1}: {name}: {rate:.0f} states/s, {reading.cpu:.1f} s of CPU", file=sys.stderr)
    counts = {reading.states for parts in readings.values() for reading in parts}
    if len(counts) > 1:
        raise SystemExit(f"the readers do not agree on the number of states: {sorted(counts)}")
    return readings


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--states", type=int, default=2_000_000)
    parser.add_argument("--replicas", type=int, default=1, help="numbers in a state")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--only", action="store_true", help="only the reader of this software")
    parser.add_argument("--without-chunks", action="store_true", help="messages one after the other, not in chunks")
    arguments = parser.parse_args()
    names = list(READERS)[:1] if arguments.only else list(READERS)
    with tempfile.TemporaryDirectory() as workshop:
        bag = Path(workshop) / "bag"
        in_fresh_process(make_bag, bag, arguments.states, arguments.replicas)
        if arguments.without_chunks:
            in_fresh_process(without_chunks, bag)
        size = sum(file.stat().st_size for file in bag.glob("*.mcap"))
        readings = measure(bag, arguments.rounds, names)
    ours = readings[names[0]]
    print(f"{ours[0].states:,} states of length {arguments.replicas}, {size / 1e6:.0f} MB, {arguments.rounds} rounds\n")
    print(
        "| reader | states per second | times as fast is `read_bag` | by CPU time | peak [MB] | less the result [MB] |"
    )
    print("|---|---:|---:|---:|---:|---:|")
    for name, parts in readings.items():
        rate = statistics.median(part.states / part.seconds for part in parts)
        pairs = list(zip(parts, ours, strict=True))
        ratio = statistics.median(part.seconds / own.seconds for part, own in pairs)
        by_cpu = statistics.median(part.cpu / own.cpu for part, own in pairs)
        times = " | " if name == names[0] else f"{ratio:.1f} | {by_cpu:.1f}"
        peak = max(part.peak for part in parts) / 1e6
        rest = max(part.peak - part.arrays for part in parts) / 1e6
        print(f"| {name} | {rate:,.0f} | {times} | {peak:.0f} | {rest:.0f} |")


if __name__ == "__main__":
    main()
