"""What a state costs a recorder once its batch has arrived: CPU time and bytes, by compression and splitting.

Five agents of the twin's line and ring, received and written as the recorder does it.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

from msg_agents.nodes.agent_group import BATCH_SIZE
from msg_agents.nodes.recorder import write_size
from msg_agents.stepping.state_receiver import StateReceiver
from msg_analysis.bags.stored_file import COMPRESSIONS, Storage
from msg_analysis.bags.writing import BagWriter
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.messages.cdr import encode_batch
from msg_analysis.messages.messages import StateCodec
from msg_analysis.messages.topics import STATE, STATES, network_topics
from msg_analysis.model.run_record import RunRecord
from msg_analysis.twin.simulate import simulate

SPLITS = (None, 5_000_000)  # bytes
DURATION = 2000.0  # 200,005 states


def run_of(replicas: int) -> tuple[RunRecord, list[bytes]]:
    """A run, and the batches in which its states come to the recorder."""
    experiment = {
        "name": "recording",
        "graphs": {"line": {"path": [1, 2, 3, 4, 5]}, "ring": {"cycle": [1, 2, 3, 4, 5]}},
        "switching": {"generator": [[-0.5, 0.5], [0.5, -0.5]]},
        "run": {"dt": 0.05, "duration": DURATION, "replicas": replicas},
    }
    run = simulate(Experiment.parse(experiment))
    codecs = [StateCodec(run.record.run.bytes, i + 1, replicas, 0.05) for i in range(5)]
    sent, found, size = [], [], 0
    for k, states in enumerate(run.states):
        for i, codec in enumerate(codecs):
            sent.append(codec.wrap(k, 1 if k else 0, states[i].tobytes()))
            size += len(sent[-1])
            if size >= BATCH_SIZE:
                found.append(encode_batch(run.record.run.bytes, sent))
                sent, size = [], 0
    return run.record, [*found, encode_batch(run.record.run.bytes, sent)]


def main() -> None:
    """Print the table of docs/performance.md."""
    argparse.ArgumentParser(description=__doc__.partition("\n")[0]).parse_args()
    print("| replicas | compression | split | CPU per state | bytes per state |\n|---:|---|---|---:|---:|")
    for replicas in (1, 16):
        record, batches = run_of(replicas)
        for compression in COMPRESSIONS:
            for split in SPLITS:
                receiver = StateReceiver(record, STATES, STATE, "/")
                with tempfile.TemporaryDirectory() as folder:
                    bag = BagWriter(Path(folder) / "bag", network_topics(5), storage=Storage(compression, split))
                    begun = time.process_time()
                    for number, batch in enumerate(batches, start=1):
                        if receiver.add(batch) >= write_size(5) or number == len(batches):
                            found = receiver.take()
                            bag.write_many(receiver.names, found.agent, found.time, found.data, found.start, found.size)
                    bag.close()
                    spent = (time.process_time() - begun) / bag.messages * 1e6
                    size = sum(file.stat().st_size for file in bag.directory.glob("*.mcap")) / bag.messages
                    often = f"{split // 10**6} MB" if split else "no"
                    print(f"| {replicas} | {compression} | {often} | {spent:.1f} µs | {size:.0f} |")


if __name__ == "__main__":
    main()
