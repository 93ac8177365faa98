"""Threads of linear algebra, hostile text, files that are whole, requests to fork servers, and how far work is."""

import os
import re
from dataclasses import dataclass
from pathlib import Path

import many_commands
import numpy as np
import pytest
import scipy.linalg  # its library of linear algebra is another one than that of numpy
import yaml
from full_disk import full_disk
from threadpoolctl import threadpool_info, threadpool_limits

from experiments import GOLDEN, compare, line_ring, read_bag, simulate, write_trajectory
from msg_analysis.cli.console import SweepProgress, WorkProgress
from msg_analysis.common.files import DEEPEST, MOST_REPEATED, load_yaml, read_text, write_whole
from msg_analysis.common.resources import LARGE, few_blas_threads, tell, watched
from msg_analysis.common.text import duration_text


@dataclass
class Network:
    agents: int


@few_blas_threads
def threads(network: Network, size: int, *, more: int = 0) -> set[int]:
    """Of BLAS, while this runs."""
    assert scipy.linalg.norm(np.ones(size + more)) == pytest.approx((size + more) ** 0.5)
    assert network.agents > 0
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


def test_small_networks_have_one_thread() -> None:
    with threadpool_limits(3, user_api="blas"):
        before = {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}
        assert threads(Network(LARGE - 1), 2, more=1) == {1}
        assert threads(Network(LARGE), 2) == before
        assert threads(Network(5), 2) == {1}
        assert {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"} == before


def bomb(levels: int) -> str:
    """A list of ten lists of ten lists ...; in a few hundred bytes."""
    lines = ["a0: &q0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    lines += [f"a{i}: &q{i} [{', '.join([f'*q{i - 1}'] * 10)}]" for i in range(1, levels)]
    return "\n".join(lines)


def test_aliases_of_yaml() -> None:
    """As in YAML, up to a limit of what they repeat."""
    assert load_yaml("a: &x [1, 2]\nb: [*x, *x]\nc: {<<: {d: *x}}", yaml.SafeLoader) == {
        "a": [1, 2], "b": [[1, 2], [1, 2]], "c": {"d": [1, 2]},
    }  # fmt: skip
    assert len(load_yaml(bomb(5), yaml.SafeLoader)) == 5
    with pytest.raises(yaml.MarkedYAMLError, match=f"aliases repeat more than {MOST_REPEATED} values"):
        load_yaml(bomb(7), yaml.SafeLoader)
    with pytest.raises(yaml.MarkedYAMLError, match="alias 'x' stands inside what it names"):
        load_yaml("a: &x [1, *x]", yaml.SafeLoader)
    with pytest.raises(yaml.YAMLError, match="undefined alias"):
        load_yaml("a: *x", yaml.SafeLoader)


def test_depth_of_yaml() -> None:
    assert load_yaml("[" * DEEPEST + "]" * DEEPEST, yaml.SafeLoader)
    for brackets in ("[", "{a: "):
        with pytest.raises(yaml.MarkedYAMLError, match="nested too deeply"):
            load_yaml(brackets * (DEEPEST + 1), yaml.SafeLoader)


def test_length_of_text(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("é" * 1000, encoding="utf-8")
    assert read_text(file, 2000) == "é" * 1000
    with pytest.raises(OSError, match="longer than 0 MB"):
        read_text(file, 1999)
    with pytest.raises(OSError, match="longer than 64 MB"):
        read_text(Path("/dev/zero"))


def test_commands_refuse_hostile_text(tmp_path: Path) -> None:
    """One error, exit code 2, within 1 GB of memory."""
    (tmp_path / "bomb").write_text(f"{bomb(9)}\ngraphs: {{g: {{path: *q8}}}}\n")
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag/metadata.yaml").write_text(f"{bomb(9)}\nrosbag2_bagfile_information: {{files: *q8}}\n")
    places, out = [str(tmp_path / "bomb"), str(tmp_path / "bag"), "/dev/zero"], ["--out", str(tmp_path / "out")]
    commands = [["info"], ["simulate", *out], ["compare"], ["tabulate"], ["sweep", *out]]
    jobs = [["msg-analysis", [word, place, *more], "memory"] for word, *more in commands for place in places]
    for job, (code, stdout, stderr) in zip(jobs, many_commands.outcomes(jobs, tmp_path, NO_COLOR="1"), strict=True):
        assert (code, stdout) == (2, ""), (job, stderr)
        assert stderr.startswith("error: ") or "Error: " in stderr
        assert "Traceback" not in stderr
        assert len(stderr) < 2000


def test_no_room(tmp_path: Path) -> None:
    """The write itself fails: what was there stays, and of the rest nothing is left."""
    file = tmp_path / "file"
    file.write_bytes(b"before")
    with full_disk(1000), pytest.raises(OSError, match="File too large"):
        write_whole(file, bytes(10**5))
    assert file.read_bytes() == b"before"
    assert list(tmp_path.iterdir()) == [file]


def test_a_file_like_any_other(tmp_path: Path) -> None:
    """Replaced, and with the permissions that the user's mask gives."""
    file = tmp_path / "file"
    file.write_bytes(b"before")
    mask = os.umask(0o027)
    try:
        assert write_whole(file, b"after") == file
    finally:
        os.umask(mask)
    assert (file.read_bytes(), file.stat().st_mode & 0o777) == (b"after", 0o640)
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.parametrize(("program", "command"), [("msg-analysis", "simulate"), ("msg-agents", "run")])
def test_a_place_that_is_not_utf8(program: str, command: str, tmp_path: Path) -> None:
    """One error that names it, before anything starts; nothing is made."""
    if program == "msg-agents":
        pytest.importorskip("rclpy")
    place = tmp_path / "place"
    place.mkdir()
    job = [program, [command, str(GOLDEN / "line_ring.yaml"), "--out", os.fsdecode(bytes(place) + b"/\xff")], "pipe"]
    ((code, stdout, stderr),) = many_commands.outcomes([job], tmp_path)
    assert (code, stdout) == (2, "")
    assert re.fullmatch(r"error: .*\\udcff: not UTF-8: choose a name in UTF-8\n", stderr)
    assert list(place.iterdir()) == []


def test_what_is_told(tmp_path: Path) -> None:
    """Every stage from 0 on, never beyond its end; nobody is told outside."""
    run = simulate(line_ring(run={"dt": 0.1, "duration": 200, "replicas": 1}))
    write_trajectory(run, tmp_path / "bag")
    told: dict[str, list[tuple[int, int]]] = {}
    with watched(lambda what, done, total: told.setdefault(what, []).append((done, total))):
        compare(read_bag(tmp_path / "bag"))
    tell("nothing", 1, 2)
    stages = ["reading bag", "reading bag_0.mcap", "errors", "errors given the path", "residuals"]
    assert list(told) == stages
    for steps in told.values():
        assert all(0 <= done <= total for done, total in steps)
        assert [done for done, _ in steps] == sorted(done for done, _ in steps)


def test_short_work_shows_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    with WorkProgress() as progress, watched(progress):
        tell("reading", 1, 2)
    assert capfd.readouterr() == ("", "")


def test_long_work_says_how_far_it_is(capfd: pytest.CaptureFixture[str]) -> None:
    """A line every ten seconds where there is no terminal."""
    now = [100.0]
    with WorkProgress(clock=lambda: now[0]) as progress, watched(progress):
        for second in range(25):
            now[0] = 100.0 + second
            tell("reading x.mcap", second, 25)
    assert capfd.readouterr().err == "reading x.mcap: 40 %\nreading x.mcap: 80 %\n"


def test_a_sweep_says_what_is_left(capfd: pytest.CaptureFixture[str]) -> None:
    """At the mean speed of what is new: 40 of 100 points were there before, each takes a second and a half."""
    now = [100.0]
    with SweepProgress("sweep", lambda: now[0]) as progress:
        progress.done(40, 100, 0)
        for done in range(41, 101):
            now[0] = 100.0 + 1.5 * (done - 40)
            progress.done(done, 100, int(done > 60))
    lines = capfd.readouterr().err.splitlines()
    assert lines[0] == "sweep: 47 of 100, 10 s so far, 1 min 20 s left"
    assert lines[2] == "sweep: 61 of 100, 1 without a result, 32 s so far, 59 s left"
    assert lines[-1] == "sweep: 96 of 100, 1 without a result, 1 min 24 s so far, 6 s left"


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.2, "0 s"), (57.4, "57 s"), (59.6, "1 min 0 s"), (3599, "59 min 59 s"), (7512, "2 h 5 min")]
)
def test_durations(seconds: float, text: str) -> None:
    assert duration_text(seconds) == text
