"""How many messages "keep all" keeps: for a late reader, and for one that is stopped.

python benchmarks/keep_all_limit.py [--messages N]

A reliable writer publishes as fast as it can. A late reader of a transient-local topic joins after that; the reader of
a volatile topic is stopped before, and goes on afterwards.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import asdict

from msg_agents.doctor.qos.workers import Worker, Workers
from msg_agents.running.run_folder import workshop
from msg_agents.running.surroundings import surroundings
from msg_analysis.wire.topics import Qos

SECONDS = 10.0  # at most, for discovery, and for the messages


def join(writer: Worker, reader: Worker, topic: str, qos: Qos) -> None:
    """The reader joins, and both have discovered each other."""
    reader.tell("join", topics=[topic], qos=asdict(qos), seconds=SECONDS)
    found = [writer.ask("await_readers", count=1, seconds=SECONDS), reader.answer()]
    if not all(answer["discovered"][0] for answer in found):
        raise SystemExit("writer and reader did not find each other")


def sent_by(writer: Worker) -> int:
    return len(writer.ask("report")["sent"][0][0])


def received_by(reader: Worker, messages: int) -> str:
    """How many, and which, once no more come."""
    reader.ask("await", must=(0, 0), may=(0, messages), seconds=SECONDS, quiet=1.0)
    numbers = reader.ask("report")["received"][0][0]
    return f"{len(numbers)} received" + (f", from {numbers[0]} to {numbers[-1]}" if numbers else "")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--messages", type=int, default=5050)
    count = parser.parse_args().messages
    with workshop() as folder, surroundings(folder, None, {}, 3) as around, Workers(around, folder) as workers:
        (writer,) = workers.start("writer")
        latched, volatile = Qos(latched=True), Qos()

        writer.ask("create", topics=["latched"], qos=asdict(latched))
        writer.ask("publish", numbers=(0, count), period=0.0)
        (late,) = workers.start("reader")
        join(writer, late, "latched", latched)
        print(f"late reader: {sent_by(writer)} of {count} accepted, {received_by(late, count)}")
        writer.ask("close")
        late.leave()

        writer.ask("create", topics=["volatile"], qos=asdict(volatile))
        (stopped,) = workers.start("reader")
        join(writer, stopped, "volatile", volatile)
        stopped.stop()
        begun = time.monotonic()
        writer.ask("publish", numbers=(0, count), period=0.0)
        took, accepted = time.monotonic() - begun, sent_by(writer)
        stopped.resume()
        refused = f"{count - accepted} refused in {took:.1f} s"
        print(f"stopped reader: {accepted} of {count} accepted, {refused}, {received_by(stopped, count)}")


if __name__ == "__main__":
    main()
