"""What is done is done once, what fails fails alone, and all runs are judged together."""

import csv
import dataclasses
import os
import signal
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pyarrow
import pytest
import yaml
from worker_jobs import cubes, first_last, killed_by_the_third, much_memory, sockets

import experiments
from msg_analysis.errors import InputError
from msg_analysis.sweeps import workers as conducting
from msg_analysis.sweeps.cluster import ClusterWorkers
from msg_analysis.sweeps.grid import load_sweep
from msg_analysis.sweeps.points import DONE, FAILED, Job, Outcome, evaluate
from msg_analysis.sweeps.results import (
    JOURNAL,
    ResultStore,
    arrow_table,
    evaluate_sweep,
    picture,
    rows_of,
    write_tables,
)
from msg_analysis.sweeps.workers import LocalWorkers, Lost, WorkersLostError, in_order, run_jobs
from msg_analysis.theory.sampling import sampled_prediction


def document(rate: float = 1.0, **run: Any) -> dict[str, Any]:
    return experiments.document(5, rate, run={"dt": 0.1, "duration": 100, "replicas": 1, **run})


def with_p(p: float | None, **result: Any) -> Outcome:
    kept = {"verdict": "agrees", "p": p, **result}
    return Outcome(str(p), DONE, None, kept, 1.0, "", "")


FAILURE = Outcome("x", FAILED, "broke", {}, 1.0, "", "")


def in_this_process(monkeypatch: pytest.MonkeyPatch) -> list[Job]:
    """Have jobs done here; what was done."""
    done: list[Job] = []

    class Here:
        def __init__(self, *_: Any) -> None: ...

        def __enter__(self) -> Any:
            return self

        def __exit__(self, *_: object) -> None: ...

        def outcomes(self, function: Any, items: Any, **_: Any) -> Any:
            for item in items:
                done.append(item)
                yield [(item, function(item, lambda: False))]

    monkeypatch.setattr(conducting, "LocalWorkers", Here)
    return done


def test_ctrl_c_while_an_outcome_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What counts as kept is what is on the disk."""
    in_this_process(monkeypatch)
    written = os.write

    def write(descriptor: int, data: bytes) -> int:
        signal.raise_signal(signal.SIGINT)
        return written(descriptor, data)

    monkeypatch.setattr("msg_analysis.sweeps.results.os.write", write)
    with ResultStore.open(tmp_path) as store:
        with pytest.raises(KeyboardInterrupt):
            run_jobs([Job.of("predict", document(rate)) for rate in (0.5, 1.0)], store)
        assert len(store.outcomes) == (tmp_path / JOURNAL).read_bytes().count(b"\n") == 1


def test_what_fails_fails_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whether steps with delayed values are stable, only the prediction finds out."""
    done = in_this_process(monkeypatch)
    bad = document(dt=0.55, duration=55) | {"noise": {"delay": 3}}
    jobs = [Job.of("predict", document()), Job.of("predict", bad), Job.of("predict", document(2.0))]
    with ResultStore.open(tmp_path) as store:
        conducted = run_jobs(jobs, store)
    assert [outcome.status for outcome in conducted.outcomes] == [DONE, FAILED, DONE]
    assert "grow without bound" in (conducted.outcomes[1].reason or "")
    assert len(done) == 3
    judgement = evaluate_sweep(conducted.outcomes, 0.01)
    assert (judgement.verdict, judgement.exit_code) == ("incomplete", 3)
    # Again: nothing is done, unless what failed is to be tried again.
    with ResultStore.open(tmp_path) as store:
        assert run_jobs(jobs, store).reused == 3
        assert len(done) == 3
        run_jobs(jobs, store, retry=True)
        assert [job.id for job in done[3:]] == [jobs[1].id]


def test_defects_fail_alone_too() -> None:
    outcome = evaluate(Job("x", "predict", "{}", 0.01))
    assert outcome.status == FAILED
    outcome = evaluate(Job("x", "predict", "nonsense", 0.01))
    assert "JSONDecodeError" in (outcome.reason or "")


def test_equal_points_are_done_once_and_others_are_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done = in_this_process(monkeypatch)
    one, two = Job.of("predict", document()), Job.of("predict", document(2.0))
    with ResultStore.open(tmp_path) as store:
        conducted = run_jobs([one, one, two], store)
        assert len(done) == 2
        assert conducted.outcomes[0] == conducted.outcomes[1]
        assert run_jobs([two], store).reused == 1
        assert len(store.outcomes) == 2


def test_other_software_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done = in_this_process(monkeypatch)
    job = Job.of("predict", document())
    with ResultStore.open(tmp_path) as store:
        run_jobs([job], store)
        store.add([dataclasses.replace(store.outcomes[job.id], software="msg_analysis 0.0.1")])
        with pytest.raises(InputError, match=r"1 results were made with other software \(msg_analysis 0.0.1\)"):
            run_jobs([job], store)
        assert run_jobs([job], store, other_software="keep").outcomes[0].software == "msg_analysis 0.0.1"
        assert len(done) == 1
        assert run_jobs([job], store, other_software="redo").outcomes[0].software != "msg_analysis 0.0.1"
        assert len(done) == 2
        run_jobs([job], store)
        assert len(done) == 2


@pytest.mark.parametrize(
    ("p_values", "p_adjusted", "verdict", "code"),
    [
        ([0.5, 0.02, 0.9], [1.0, 0.06, 1.0], "agrees", 0),  # by itself .02, of three .06
        ([0.5, 0.003, 0.9], [1.0, 0.009, 1.0], "disagrees", 1),
        ([0.004, 0.006], [0.008, 0.008], "disagrees", 1),
        ([None, 0.5], [None, 0.5], "agrees", 0),
    ],
)
def test_all_runs_are_judged_together(p_values: Any, p_adjusted: Any, verdict: str, code: int) -> None:
    judgement = evaluate_sweep([with_p(p) for p in p_values], 0.01)
    assert judgement.p_adjusted == pytest.approx(p_adjusted)
    assert (judgement.verdict, judgement.exit_code) == (verdict, code)


def test_a_failure_does_not_hide_a_disagreement() -> None:
    assert evaluate_sweep([with_p(1e-9), FAILURE], 0.01).exit_code == 1
    assert evaluate_sweep([with_p(0.5), FAILURE], 0.01).exit_code == 3
    assert evaluate_sweep([with_p(0.5, unpredicted="a protocol")], 0.01).verdicts == ("unpredicted",)


def test_what_kills_its_workers_is_given_up_and_the_others_are_done() -> None:
    """Real workers: each death is that of a process, and a new one takes its place."""
    with LocalWorkers(2) as pool, closing(pool.outcomes(cubes, list(range(30)))) as batches:
        found = dict(pair for batch in batches for pair in batch)
    lost = found.pop(13)
    assert isinstance(lost, Lost)
    assert "killed every worker" in lost.reason
    assert found == {number: number**3 for number in range(30) if number != 13}


def test_nobody_else_can_reach_a_worker() -> None:
    """It has one socket, without a name; there are no others than before in this process."""
    before = psutil.Process().net_connections("inet")
    with LocalWorkers(1) as pool, closing(pool.outcomes(sockets, [1])) as batches:
        assert list(batches) == [[(1, [""])]]
        assert psutil.Process().net_connections("inet") == before
        (worker,) = pool._processes.values()
    assert worker.poll() is not None


@pytest.mark.skipif(sys.platform != "linux", reason="this machine: no limit of data")
def test_memory_of_a_worker_is_bounded() -> None:
    """What needs more than there is fails, and only that."""
    with LocalWorkers(1) as pool, closing(pool.outcomes(much_memory, [10])) as batches:
        assert list(batches) == [[(10, 10)]]
        with pytest.raises(MemoryError):
            list(pool.outcomes(much_memory, [psutil.virtual_memory().total]))


def test_workers_that_do_not_start(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "/bin/false")
    with LocalWorkers(2) as pool, pytest.raises(WorkersLostError, match="cannot be started: exit code 1"):
        list(pool.outcomes(cubes, list(range(30))))
    monkeypatch.setattr(sys, "executable", "/nowhere")
    with LocalWorkers(2) as pool, pytest.raises(InputError, match="--workers: number 1 cannot be started"):
        list(pool.outcomes(cubes, list(range(30))))


def test_results_in_order(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without end, whichever comes first, over the end of a sequence of batches too."""
    monkeypatch.setattr(conducting, "MANY", 5)
    with closing(in_order(first_last, 2, None)) as results:
        assert [next(results) for _ in range(12)] == [k**3 for k in range(12)]
    with closing(in_order(killed_by_the_third, 2, None)) as results:
        assert [next(results), next(results)] == [0, 1]
        with pytest.raises(InputError, match="batch 2: killed every worker that tried it"):
            next(results)


def test_a_scheduler_that_does_not_answer() -> None:
    with pytest.raises(InputError, match=r"--scheduler tcp://127\.0\.0\.1:9: no answer: expected the address"):
        ClusterWorkers("tcp://127.0.0.1:9", patience=0.2).__enter__()


def numbers(cell: str) -> str | float:
    try:
        return float(cell)
    except ValueError:
        return cell


def test_sampled_predictions_are_drawn_with_their_intervals(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    in_this_process(monkeypatch)
    lossy = document() | {"noise": {"loss": 0.2, "burst": 5}}
    file = {"experiment": lossy, "kind": "predict", "over": {"noise.process": [1.0, 2.0]}}
    (tmp_path / "try.yaml").write_text(yaml.safe_dump(file, sort_keys=False))
    sweep = load_sweep(tmp_path / "try.yaml")
    with ResultStore.open(tmp_path) as store:
        outcomes = run_jobs([point.job for point in sweep.points], store).outcomes
    rows = rows_of(sweep, outcomes, evaluate_sweep(outcomes, 0.01))
    wanted = sampled_prediction(experiments.Experiment.parse(lossy))
    names = ("system_error", "system_error.low", "system_error.high")
    assert [rows[0][f"emulated.{name}"] for name in names] == [wanted.system_error, *wanted.interval]
    shown = picture(sweep, rows)
    place = shown.series[0].places[0]
    assert (shown.measured, shown.intervals) == (False, True)
    assert (place.value, place.low, place.high) == pytest.approx((wanted.system_error, *wanted.interval))


def test_columns_and_what_is_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    in_this_process(monkeypatch)
    over = {"noise.process": [1.0, [1, 2, 1, 1, 1]], "switching.generator": [[[-1, 1], [1, -1]], [[-9, 9], [9, -9]]]}
    file = {"experiment": document(), "kind": "simulate", "over": over, "repetitions": 3}
    (tmp_path / "try.yaml").write_text(yaml.safe_dump(file, sort_keys=False))
    sweep = load_sweep(tmp_path / "try.yaml")
    with ResultStore.open(tmp_path) as store:
        outcomes = run_jobs([point.job for point in sweep.points], store).outcomes
    rows = rows_of(sweep, outcomes, evaluate_sweep(outcomes, 0.01))
    table = arrow_table(rows)
    assert table.num_rows == 12
    parsed = []
    for library in (pyarrow, None):  # a new one beside an older NumPy cannot be imported
        monkeypatch.setitem(sys.modules, "pyarrow", library)
        files = {file.suffix: file for file in write_tables(rows, {}, tmp_path)}
        parsed.append([[numbers(cell) for cell in row] for row in csv.reader(files[".csv"].open(newline=""))])
    assert parsed[0] == parsed[1]
    assert ".parquet" not in files
    monkeypatch.setitem(sys.modules, "pyarrow", pyarrow)
    assert str(table.schema.field("node_errors[2].measured").type) == "double"
    assert str(table.schema.field("seed").type) == "int64"
    assert table.column("noise.process").to_pylist()[::6] == ["1.0", "[1, 2, 1, 1, 1]"]
    shown = picture(sweep, rows, "node_errors[2]")
    assert [len(series.places) for series in shown.series] == [2, 2]
    assert shown.x == "noise.process"
    three = [row for row in rows if row["noise.process"] == 1.0 and row["switching.generator"][0][0] == -1]
    assert shown.series[0].places[0].value == pytest.approx(np.mean([row["node_errors[2].measured"] for row in three]))
    error = np.sqrt(np.sum([row["node_errors[2].standard_error"] ** 2 for row in three])) / 3
    high = shown.series[0].places[0].high
    assert high - shown.series[0].places[0].value == pytest.approx(1.96 * error, rel=1e-4)
    with pytest.raises(InputError, match="not a column of numbers: expected one of"):
        picture(sweep, rows, "nonsense")
