"""The experiments of the tests of networks: agents on a line and a ring, and run records of them."""

from pathlib import Path
from typing import Any

import experiments
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.model.run import Run
from msg_analysis.twin.check import check
from msg_analysis.twin.simulate import new_record


def document(agents: int = 5, /, **changes: Any) -> dict[str, Any]:
    """300 steps; ``run`` is merged, other keys are replaced."""
    run = {"duration": 15, "seed": 7} | changes.pop("run", {})
    return experiments.document(agents, **changes, run=run)


def experiment(agents: int = 5, /, **changes: Any) -> Experiment:
    """See ``document``."""
    return Experiment.parse(document(agents, **changes))


def run_file(directory: Path, agents: int = 3, /, **changes: Any) -> Path:
    """A run record in the file run.json of a directory; see ``document``."""
    file = directory / "run.json"
    file.write_text(new_record(experiment(agents, **changes)).to_json(with_key=True))
    return file


def record_of_two(directory: Path) -> Path:
    """File run.json of a run of two agents: one of them waits for the other."""
    line = {"graphs": {"line": {"path": [1, 2]}}, "switching": {"generator": [[0]]}}
    return run_file(directory, 2, **line, run={"duration": 1, "start": "zero"})


def assert_equal_to_twin(run: Run) -> None:
    """Complete, each state once, and what the law and the seed give, to the last bit."""
    assert run.completeness.complete
    assert run.completeness.duplicates == 0
    outcome = check(run)
    assert (outcome.difference, outcome.missing, outcome.compared) == (None, 0, run.completeness.expected)
