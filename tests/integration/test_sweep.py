"""Sweeps on a real cluster whose worker is killed, and of real networks."""

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from programs import put_foreign_files

from msg_analysis.errors import ExitCode
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.inference.pool import compare
from msg_analysis.paper import figures as emulation
from msg_analysis.twin.simulate import simulate

BIN = Path(sys.executable).parent


def sweep_file(network: Any, **sweep: Any) -> Path:
    path = network.directory / "rates.yaml"
    experiment = network.experiment(run={"processes": 2}).to_document()
    path.write_text(yaml.safe_dump({"experiment": experiment, **sweep}, sort_keys=False))
    return path


def lines(journal: Path) -> int:
    return journal.read_bytes().count(b"\n") if journal.exists() else 0


def check_against_the_twin(network: Any, points: list[dict[str, Any]]) -> None:
    """A run of the network in lockstep is that of the twin to the last bit, and so is what is measured."""
    for row in points:
        switching = {"generator": row["switching.generator"]}
        what = network.experiment(switching=switching, run={"duration": row["run.duration"], "seed": row["seed"]})
        expected = compare(simulate(what)).system_error
        assert row["system_error.measured"] == expected.measured
        assert row["system_error.standard_error"] == pytest.approx(expected.standard_error, rel=1e-9)


def generators(*rates: float) -> list[list[list[float]]]:
    return [[[-rate, rate], [rate, -rate]] for rate in rates]


@pytest.fixture
def cluster(network: Any) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """A scheduler and two workers, as `dask scheduler` and `dask worker` start them."""
    from distributed import Client  # here, since every worker of the tests would import it

    where = network.directory / "scheduler.json"
    quiet: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    started = [
        subprocess.Popen(
            [BIN / "dask", "scheduler", "--host", "127.0.0.1", "--port", "0", "--dashboard-address", "127.0.0.1:0",
             "--scheduler-file", where], **quiet
        )
    ]  # fmt: skip
    network.wait_for(lambda: where.exists() and where.read_text().endswith("}"), 60, "the scheduler")
    address = json.loads(where.read_text())["address"]
    worker = [BIN / "dask", "worker", address, "--nthreads", "1", "--no-nanny", "--dashboard-address", "127.0.0.1:0"]
    started += [subprocess.Popen([*worker, "--local-directory", network.directory], **quiet) for _ in range(2)]
    with Client(address) as client:
        client.wait_for_workers(2, timeout=60)
    yield address, started[1:]
    for process in started:
        process.kill()
        process.wait()


def test_a_worker_is_killed_in_the_middle(network: Any, cluster: tuple[str, list[subprocess.Popen[bytes]]]) -> None:
    address, workers = cluster
    out = network.directory / "out"
    rates = [0.25 * 1.3**k for k in range(12)]
    path = sweep_file(network, kind="simulate", over={"switching.generator": generators(*rates), "run.duration": [150]})
    process = network.start("sweep", path, "--scheduler", address, "--out", out, "--json", program="msg-analysis")
    network.wait_for(lambda: lines(out / "points.jsonl") >= 2, 60, "results")
    workers[0].kill()
    result = network.result(process)
    assert (result["done"], result["failed"], result["verdict"]) == (12, 0, "agrees")
    assert lines(out / "points.jsonl") == 12
    places = {json.loads(line)["place"] for line in (out / "points.jsonl").read_text().splitlines()}
    assert len(places) <= 2
    check_against_the_twin(network, result["points"][::3])


def test_errors_sampled_on_a_cluster(network: Any, cluster: tuple[str, list[subprocess.Popen[bytes]]]) -> None:
    """The same numbers to the last bit with two workers, with one of them, and without."""
    address, workers = cluster
    file, found = network.file(), []
    for words in (["--scheduler", address], ["--scheduler", address], []):
        process = network.start("predict", file, "--precision", "0.5%", *words, "--json", program="msg-analysis")
        emulated = network.result(process)["emulated"]
        found.append([emulated[key] for key in ("interval", "node_intervals", "paths")])
        workers[0].kill()
    assert found[0] == found[1] == found[2]
    workers[1].kill()
    workers[1].wait()
    process = network.start("predict", file, "--scheduler", address, program="msg-analysis")
    assert "has no workers: expected some: start `dask worker`" in network.ended(process, ExitCode.BAD_INPUT)[1]


@pytest.mark.timeout(300)  # waits of several sweeps, on a machine that has much else to do
def test_networks_interrupted_killed_and_resumed(network: Any) -> None:
    """Sweeps in one directory: ended by SIGTERM, killed, resumed with a network that fails."""
    # The false-alarm rate of the verdict is 1 %, with fixed seeds: none.
    out = network.directory / "out"

    def started(*durations: int, workers: tuple[str, ...] = ()) -> Any:
        rates = {15: 0.5, 10_000: 0.5, 20: 1.0}
        over = {
            "switching.generator": generators(*(rates[each] for each in durations)),
            "run.duration": list(durations),
            "run.pace": ["realtime" if each == 10_000 else "lockstep" for each in durations],  # it costs less
        }
        file = sweep_file(network, kind="network", over=over, combine="zip")
        return network.start("sweep", file, *workers, "--out", out, "--json", program="msg-analysis")

    two = ("--workers", "2")
    process = started(15, 10_000, workers=two)
    network.wait_for(lambda: lines(out / "points.jsonl") == 1, 100, "the shorter run")
    process.terminate()  # as a queue of a cluster does; Ctrl-C: tests/analysis/cli/test_sweep.py
    stdout, stderr = network.ended(process, 128 + signal.SIGTERM)
    assert stdout == ""
    assert "Traceback" not in stderr
    assert network.processes() == []
    assert "interrupted: 1 of 2 points are kept" in stderr

    process = started(15, 10_000, workers=two)
    network.wait_for(lambda: network.processes("recorder"), 60, "a network")
    process.kill()
    process.communicate()
    network.wait_for(lambda: not network.processes(), 60, "the end of all processes")
    assert lines(out / "points.jsonl") == 1

    process = started(15, 10_000, 20)
    network.wait_for(lambda: network.processes("recorder"), 60, "the second network")
    (run,) = network.processes("run")
    run.kill(signal.SIGINT)
    stdout, stderr = network.ended(process, 3)
    result = json.loads(stdout)
    assert result["kept"] == 1
    assert [row["status"] for row in result["points"]] == ["done", "failed", "done"]
    assert result["points"][1]["reason"].startswith("stopped by Ctrl-C")
    check_against_the_twin(network, [row for row in result["points"] if row["status"] == "done"])
    assert not (out / "runs" / "report.html").exists()
    assert len(list((out / "runs").iterdir())) == 1  # the others agree: their bags are not kept


@pytest.mark.timeout(300)
def test_points_on_the_curves_of_the_paper(network: Any) -> None:
    """Short form: two networks, started among files that none of their processes may execute."""
    # Level of the family of all points: 1 %, with fixed seeds: no alarm.
    runs = [
        emulation.PlannedRun(1, "line_ring", 0.5, 1.0, 1.0, duration=20.0),
        emulation.PlannedRun(3, "smallest", 5.0, 1.0, 1.0, leader=2, duration=20.0),
    ]
    figures = network.directory / "figures"
    options = ["--emulate", "--format", "svg", "--out", str(figures)]
    code = [
        "from functools import partial",
        "from pathlib import Path",
        "from msg_analysis.cli.main import main",
        "from msg_analysis.paper import examples, figures",
        "from msg_analysis.paper.figures import PlannedRun",
        f"figures.runs_of = lambda number: [run for run in {runs} if run.example == number]",
        "examples.EXAMPLES |= {k: partial(example, 3) for k, example in examples.EXAMPLES.items()}  # coarse curves",
        "for number in ('all', '1'):  # the second time, nothing runs",
        "    try:",
        f"        main(['figures', number, *{options!r}])",
        "    except SystemExit as end:",
        f"        points = Path({str(figures / 'emulation/points.jsonl')!r}).read_text()",
        "        print('ended', end.code, points.count('\\n'))",
    ]
    command = [sys.executable, "-P", "-c", "\n".join(code)]
    folder, executed = network.directory / "folder", network.directory / "executed"
    folder.mkdir()
    put_foreign_files(folder, executed)
    result = subprocess.run(command, capture_output=True, text=True, timeout=280, cwd=folder)
    assert result.returncode == 0, result.stderr
    assert not executed.exists(), executed.read_text()
    first, second, rest = result.stdout.split("ended 0 2\n")
    for text, counts in ((first, "7 points of 2 networks"), (second, "6 points of 1 networks")):
        assert f"{counts}: all agree with theory (Holm over all points, level 0.01" in text
    assert rest == ""
    rows = (figures / "example_1_emulated.csv").read_text().splitlines()
    assert rows[2].startswith("network,quantity,agent")
    assert len(rows) == 3 + 6
    measured = compare(simulate(Experiment.parse(json.loads(runs[0].job().document)))).system_error.measured
    assert float(rows[3].split(",")[6]) == 1.0 / measured
