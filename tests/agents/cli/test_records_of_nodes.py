"""The run record of a node: read once for all that are forked, or by the node itself."""

import json
from pathlib import Path
from typing import Any

import pytest
from networks import run_file

from msg_agents.cli import nodes
from msg_agents.cli.nodes import load_record, read_record_ahead
from msg_analysis.errors import InputError


@pytest.fixture(autouse=True)
def _nothing_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(nodes, "_read_ahead", {})


def written(directory: Path, **changes: Any) -> Path:
    run = {"dt": changes.pop("dt", 0.05), "duration": 5, "start": [1.0, -1.0, 2.0], "replicas": 1}
    return run_file(directory, 3, **changes, run=run)


def test_read_once(tmp_path: Path) -> None:
    file = written(tmp_path)
    alone = load_record(file)
    read_record_ahead(file)
    known = load_record(file)
    read_record_ahead(file)
    assert load_record(file) is known
    assert "model" in vars(known)
    assert (known.to_json(with_key=True), known.key) == (alone.to_json(with_key=True), alone.key)
    file.unlink()  # the processes that are forked need the file no more
    assert load_record(file) is known


def test_the_code_of_a_protocol_is_left_to_the_nodes(tmp_path: Path) -> None:
    file = written(tmp_path, protocol={"name": "saturated"})
    read_record_ahead(file)
    file.unlink()
    with pytest.raises(InputError, match=r"run\.json: cannot be read"):
        load_record(file)


@pytest.mark.parametrize("text", ["", "{}", '{"format": 1}', "\x00"])
def test_what_is_no_record_is_an_error_of_the_node(tmp_path: Path, text: str) -> None:
    file = tmp_path / "run.json"
    file.write_text(text)
    read_record_ahead(file)
    read_record_ahead(tmp_path / "missing.json")
    with pytest.raises(InputError, match=r"run\.json: not a run record"):
        load_record(file)


@pytest.mark.parametrize(("key", "words"), [("started", "KeyError: 'started'"), ("step", "step: missing")])
def test_what_every_record_has(tmp_path: Path, key: str, words: str) -> None:
    """The time of its start, and matrices in discrete time: those of before the first release did not."""
    file = written(tmp_path, time="discrete", switching={"transition": [[0.5, 0.5], [0.5, 0.5]]}, dt=1)
    document = json.loads(file.read_text())
    del document[key]
    file.write_text(json.dumps(document))
    with pytest.raises(InputError, match=words):
        load_record(file)
