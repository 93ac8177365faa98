"""What compression and splitting cost a recorder, and what they save: CPU time and bytes per message.

Five agents of the twin's line and ring, written over and over as the recorder writes them.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

from msg_analysis.bags.format.storage_options import COMPRESSIONS, Storage
from msg_analysis.bags.writer import BagWriter
from msg_analysis.model.experiment.experiment import ValidExperiment
from msg_analysis.twin.simulate import simulate
from msg_analysis.wire.messages import StateCodec, stamp_ns
from msg_analysis.wire.topics import network_topics

SPLITS = (None, 5_000_000)  # bytes


def messages(replicas: int) -> list[tuple[str, bytes, int]]:
    """States of a run: topic, CDR, stamp [ns]."""
    experiment = {
        "name": "recording",
        "graphs": {"line": {"path": [1, 2, 3, 4, 5]}, "ring": {"cycle": [1, 2, 3, 4, 5]}},
        "switching": {"generator": [[-0.5, 0.5], [0.5, -0.5]]},
        "run": {"dt": 0.05, "duration": 200.0, "replicas": replicas},
    }
    run = simulate(ValidExperiment.parse(experiment))
    codecs = [StateCodec(run.record.run.bytes, i + 1, replicas, 0.05) for i in range(5)]
    found = []
    for k, states in enumerate(run.states):
        for i, codec in enumerate(codecs):
            data = codec.encode(k, 1 if k else 0, states[i].copy())
            found.append((f"/agent_{i + 1}/state", data, stamp_ns(data)))
    return found


def main() -> None:
    """Print the table of docs/messages.md."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--repeat", type=int, default=5, help="times that the run is written")
    repeat = parser.parse_args().repeat
    print("| replicas | compression | split | CPU per message | bytes per message |\n|---:|---|---|---:|---:|")
    for replicas in (1, 16):
        sent = messages(replicas) * repeat
        for compression in COMPRESSIONS:
            for split in SPLITS:
                with tempfile.TemporaryDirectory() as folder:
                    bag = BagWriter(Path(folder) / "bag", network_topics(5), storage=Storage(compression, split))
                    begun = time.process_time()
                    for message in sent:
                        bag.write(*message)
                    bag.close()
                    spent = (time.process_time() - begun) / len(sent) * 1e6
                    size = sum(file.stat().st_size for file in bag.directory.glob("*.mcap")) / len(sent)
                    often = f"{split // 10**6} MB" if split else "no"
                    print(f"| {replicas} | {compression} | {often} | {spent:.1f} µs | {size:.0f} |")


if __name__ == "__main__":
    main()
