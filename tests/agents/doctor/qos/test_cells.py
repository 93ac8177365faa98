"""The cells, and how they are selected and shown."""

from __future__ import annotations

import pytest
from click.testing import CliRunner

from msg_agents.cli.main import main
from msg_agents.doctor.qos.cells import Cell, all_cells, select_cells
from msg_agents.doctor.qos.matrix import Matrix
from msg_agents.doctor.qos.table import HEADS, markdown, summary
from msg_agents.doctor.qos.tally import CellResult, Tally, Try
from msg_analysis.errors import InputError
from msg_analysis.wire.topics import Qos


def test_all_cells() -> None:
    cells = all_cells()
    assert len(cells) == len({cell.words for cell in cells}) == 2 * 2 * 4 * 5 * 2
    assert sum(cell.tries(20) for cell in cells) == 152 * 20 + 8 * 200


@pytest.mark.parametrize(
    ("only", "count"),
    [(None, 160), ("late", 32), ("late,killed", 64), ("late, reliable,transient_local", 8), ("keep_all,one", 20)],
)
def test_selection(only: str | None, count: int) -> None:
    """Words of one axis are alternatives, those of several must all hold."""
    words = {word.strip() for word in only.split(",")} if only else set()
    cells = select_cells(only)
    assert len(cells) == count
    assert all(not words or words & {*cell.words} for cell in cells)


@pytest.mark.parametrize("only", ["", "later", "late,,one", "late one"])
def test_an_unknown_word(only: str) -> None:
    with pytest.raises(InputError, match=r"^--only: '.*': expected words .* reliable, best_effort, .*many$"):
        select_cells(only)


@pytest.mark.parametrize(
    ("options", "error"),
    [
        (["--tries", "3"], "error: --tries: given without --qos: "),
        (["--only", "late"], "error: --only: given without --qos: "),
        (["--markdown"], "error: --markdown: given without --qos: "),
        (["--qos", "--markdown", "--json"], "error: --markdown: given with --json: "),
        (["--qos", "--only", "lately"], "error: --only: 'lately': expected words "),
        (["--qos", "--tries", "0"], "Invalid value for '--tries': 0 is not in the range"),
    ],
)
def test_wrong_options(options: list[str], error: str) -> None:
    """Before anything is started."""
    result = CliRunner(env={"NO_COLOR": "1"}).invoke(main, ["doctor", *options], prog_name="msg-agents")
    assert (result.exit_code, result.stdout) == (2, "")
    assert error in result.stderr


def matrix(*tries: Try) -> Matrix:
    cells = [
        CellResult(Cell(Qos(1), "first", 1), [Try(sent=40, tally=Tally(due=40, received=40))]),
        CellResult(Cell(Qos(1, reliable=False), "late", 4), tries),
    ]
    return Matrix("rmw_x", "jazzy", cells)


def test_tables() -> None:
    bad = Try(sent=40, tally=Tally(due=40, received=39, lost=1, doubled=2, latencies=[0.001, 0.002]))
    first, second = matrix(bad, bad), matrix(Try(), Try(counts=False))
    assert summary(first) == "rmw_x of Jazzy: 2 cells, 3 tries: 1 of them contradict ROS 2."
    assert summary(second) == (
        "rmw_x of Jazzy: 2 cells, 2 tries: all as ROS 2 demands; not counted: 1 "
        "(processes did not find each other, or were stopped for too long)."
    )
    lines = markdown(first).splitlines()
    assert lines[0] == "**reliable, volatile**"
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("| keep")]
    assert [len(row) for row in rows] == [len(HEADS)] * 2
    assert rows[0] == [
        "keep_last_1",
        "first",
        "one",
        "ok",
        "1",
        *["0 (0 to 97.5)"] * 2,
        *["40", "40", "0", "0", "0", "-", "-"],
    ]
    assert rows[1][:5] == ["keep_last_1", "late", "many", "doubled in 100 (16 to 100) % of tries", "2"]
    assert rows[1][7:] == ["80", "78", "2", "4", "0", "1", "2"]
    assert [cell["doubled"] for cell in first.to_json()["cells"]] == [0, 4]
    assert (first.exit_code, second.exit_code, matrix(Try()).exit_code) == (1, 3, 0)
    assert (first.to_json()["meets"], second.to_json()["meets"], second.to_json()["not_counted"]) == (False, True, 1)
