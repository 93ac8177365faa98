"""The picture of the panel in docs/watching.md, from a run: docs/images/panel.svg.

python benchmarks/panel_picture.py --step 6000
"""

from __future__ import annotations

import argparse
import io
import tempfile
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from msg_agents.run.runner import run_network
from msg_agents.watch.observer import RunObserver
from msg_agents.watch.panel import View, panel_of
from msg_agents.watch.snapshot import Snapshot, SnapshotSource
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.model.run_record import RunRecord

ROOT = Path(__file__).parents[1]
EXPERIMENT = ROOT / "analysis/msg_analysis/experiment/bundled/line_ring.yaml"
WIDTH, HEIGHT = 80, 24


class Picture(View):
    """Keeps the snapshot of the first moment at which all agents have reached a step."""

    def __init__(self, experiment: Experiment, step: int) -> None:
        super().__init__(lambda _: None, print)
        self._source, self._step = SnapshotSource(experiment), step
        self._observer: RunObserver | None = None
        self.snapshot: Snapshot | None = None

    def begin(self, record: RunRecord, checkpoints: Path | None, observer: RunObserver | None = None) -> None:
        """See View."""
        assert checkpoints is not None
        self._observer = observer or RunObserver(record, checkpoints)

    def look(self, steps: Sequence[int]) -> None:
        """See View."""
        if self._observer is None or not steps or self.snapshot is not None:
            return
        self._observer.look(min(steps))
        found = self._source.snapshot(steps, self._observer.report)
        if found.reached >= self._step:
            self.snapshot = found

    def end(self) -> None:
        """See View."""
        if self._observer is not None:
            self._observer.end()


def main() -> None:
    """Run the network, and write the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--step", type=int, default=6000)
    options = parser.parse_args()
    experiment = Experiment.load(EXPERIMENT)
    view = Picture(experiment, options.step)
    with tempfile.TemporaryDirectory() as folder:
        shown = experiment.with_run(duration=(options.step + 200) * experiment.step_length)
        run_network(shown, Path(folder), view=view)
    view.end()
    assert view.snapshot is not None
    console = Console(record=True, width=WIDTH, height=HEIGHT, file=io.StringIO(), force_terminal=True)
    console.print(panel_of(view.snapshot, experiment, width=WIDTH, height=HEIGHT))
    console.save_svg(str(ROOT / "docs/images/panel.svg"), title="msg-agents run line_ring.yaml")


if __name__ == "__main__":
    main()
