"""Thousands of damaged bags, experiment files, and logs of others: only clean errors, in bounded memory and time.

Every case is made from a seed, so that it can be made again. What is not an error for the user (InputError), what
takes longer than a minute of CPU time, or needs more memory than a network of the size allowed, is a finding: its
file is kept, and the exit code is 1. Salvaged bags must be read by mcap's own reader, with the same states as before.
"""

from __future__ import annotations

import argparse
import multiprocessing
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from pathlib import Path
from types import FrameType
from typing import Any

import fuzz_bombs
import yaml
from fuzz_bags import make_bags, mutate_bag
from fuzz_documents import BOMB, mutate_document, mutate_text
from fuzz_logs import fuzz_log, write_sources
from mcap.reader import make_reader

from msg_analysis.bags.reading import read_bag
from msg_analysis.bags.salvage import salvage
from msg_analysis.errors import InputError
from msg_analysis.experiment import limits
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.experiment.limits import unavailable
from msg_analysis.inference.pool import compare
from msg_analysis.report.documents import describe_bag, describe_experiment

ROOT = Path(__file__).parents[1]
EXPERIMENTS = [ROOT / "analysis/msg_analysis/experiment/bundled", ROOT / "tests/data/golden"]
MEMORY = 2 * 10**8  # bytes that an experiment is told that there are
ADDRESS_SPACE = 2 * 10**9  # bytes that a process gets
SECONDS = 60  # of CPU time
SMALL = 40  # agents and graphs up to which an experiment that is valid is explained, a bag compared


class TooSlowError(BaseException):
    """A case took longer than a minute of CPU time. Nobody but us catches it."""


def _too_slow(_number: int, _frame: FrameType | None) -> None:
    raise TooSlowError


def fuzz_bag(seed: int, bags: list[Path], folder: Path) -> str:
    """One damaged bag, read, explained, salvaged, compared; what came of it."""
    rng = random.Random(seed)
    bag, out = folder / "bag", folder / "out"
    mutate_bag(rng.choice(bags), bag, rng)
    outcome, trajectory = "refused", None
    try:
        trajectory = read_bag(bag)
        outcome = "complete" if trajectory.completeness.complete else "incomplete"
        if seed % 8 == 0 and trajectory.record.experiment.agents * trajectory.states.shape[2] <= SMALL:
            compare(trajectory).to_json()
    except InputError as error:
        _check_words(error)
    if seed % 3 == 0:
        try:
            describe_bag(bag)
        except InputError as error:
            _check_words(error)
    if seed % 4 == 1:
        try:
            salvage(bag, out)
        except InputError as error:
            _check_words(error)
        else:
            _check_salvaged(out, None if trajectory is None else trajectory.completeness.received)
    return outcome


def _check_salvaged(out: Path, received: int | None) -> None:
    for file in out.glob("*.mcap"):
        with file.open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True)
            summary = reader.get_summary()
            assert summary is not None
            assert summary.statistics is not None
            assert sum(1 for _ in reader.iter_messages()) == summary.statistics.message_count
    if received is not None:
        assert read_bag(out).completeness.received == received


def fuzz_experiment(seed: int, files: list[Path], folder: Path) -> str:
    """One damaged experiment file, loaded and explained; what came of it."""
    rng = random.Random(seed)
    source = rng.choice(files).read_text(encoding="utf-8")
    target = folder / "experiment.yaml"
    if seed % 2:
        text = mutate_text(source, rng)
    else:
        text = yaml.safe_dump(mutate_document(yaml.safe_load(source), rng), allow_unicode=True, sort_keys=False)
    data = text.encode("utf-8", errors="surrogatepass")
    if seed % 50 == 0:
        data = rng.choice([data[: rng.randrange(len(data) + 1)], rng.randbytes(200), data.decode().encode("utf-16")])
    if seed % 97 == 0:
        data += b"\n" + BOMB.encode()
    target.write_bytes(data)
    try:
        experiment = Experiment.load(target)
        unavailable(experiment)
        if max(experiment.agents, experiment.chain.modes) <= SMALL:
            describe_experiment(experiment)
            assert Experiment.parse(experiment.to_document()).to_document() == experiment.to_document()
    except InputError as error:
        _check_words(error)
        return "refused"
    return "valid"


def _check_words(error: InputError) -> None:
    """An error for people: some words, and not a book."""
    assert 10 < len(str(error)) < 20_000, f"message of {len(str(error))} characters: {str(error)[:300]}"


KINDS = {"bags": fuzz_bag, "experiments": fuzz_experiment, "logs": fuzz_log}


def work(task: tuple[str, int, int, list[Path], Path]) -> tuple[Counter[str], list[str], float, int]:
    """A stretch of seeds in a process of its own: outcomes, findings, the longest case [s], most memory [kB]."""
    kind, first, last, sources, findings = task
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))
    limits.available_memory = lambda: MEMORY  # type: ignore[attr-defined]
    signal.signal(signal.SIGPROF, _too_slow)
    outcomes: Counter[str] = Counter()
    found, longest = [], 0.0
    with tempfile.TemporaryDirectory(prefix="fuzz.") as place:
        for seed in range(first, last):
            folder = Path(place) / str(seed)
            folder.mkdir()
            begun = time.process_time()
            signal.setitimer(signal.ITIMER_PROF, SECONDS)  # CPU time: the machine may have other things to do
            try:
                outcomes[KINDS[kind](seed, sources, folder)] += 1
            except BaseException as error:  # whatever it is, it is what is looked for
                signal.setitimer(signal.ITIMER_PROF, 0)
                if isinstance(error, KeyboardInterrupt):
                    raise
                kept = findings / f"{kind}_{seed}"
                shutil.copytree(folder, kept, dirs_exist_ok=True)
                (kept / "traceback.txt").write_text(traceback.format_exc(), encoding="utf-8", errors="replace")
                found.append(f"{kept}: {type(error).__name__}: {str(error)[:200]}")
            signal.setitimer(signal.ITIMER_PROF, 0)
            longest = max(longest, time.process_time() - begun)
            shutil.rmtree(folder)
    return outcomes, found, longest, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def run(kind: str, count: int, seed: int, sources: list[Path], findings: Path, jobs: int) -> int:
    """All cases of a kind; the number of findings."""
    step = max(1, min(500, count // (2 * jobs) or 1))
    tasks: list[Any] = [
        (kind, start, min(start + step, seed + count), sources, findings) for start in range(seed, seed + count, step)
    ]
    outcomes: Counter[str] = Counter()
    found: list[str] = []
    longest, memory = 0.0, 0
    context = multiprocessing.get_context("fork")  # all is imported already
    with context.Pool(jobs) as pool:
        for part, new, slowest, most in pool.imap_unordered(work, tasks):
            outcomes += part
            found += new
            longest, memory = max(longest, slowest), max(memory, most)
            for line in new:
                print(line, file=sys.stderr, flush=True)
    listed = ", ".join(f"{number} {name}" for name, number in sorted(outcomes.items()))
    print(f"{kind}: {count} damaged: {listed}, {len(found)} findings; longest {longest:.1f} s, {memory / 1e3:.0f} MB")
    return len(found)


def main() -> None:
    """Fuzz all kinds."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--bags", type=int, default=20_000)
    parser.add_argument("--experiments", type=int, default=20_000)
    parser.add_argument("--logs", type=int, default=10_000, help="of others, with maps")
    parser.add_argument("--bombs", action=argparse.BooleanOptionalAction, default=True, help="also fuzz_bombs.py")
    parser.add_argument("--seed", type=int, default=0, help="of the first case of each kind")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--findings", type=Path, default=Path("build/fuzz"), help="where they are kept")
    arguments = parser.parse_args()
    files = sorted(file for folder in EXPERIMENTS for file in folder.glob("*.yaml"))
    with tempfile.TemporaryDirectory(prefix="fuzz.") as place:
        bags = make_bags(Path(place)) if arguments.bags else []
        common = (arguments.findings, arguments.jobs)
        total = run("bags", arguments.bags, arguments.seed, bags, *common) if bags else 0
        if arguments.experiments:
            total += run("experiments", arguments.experiments, arguments.seed, files, *common)
        if arguments.logs:
            folder = Path(place) / "logs"
            folder.mkdir()
            total += run("logs", arguments.logs, arguments.seed, write_sources(folder), *common)
        if arguments.bombs:
            total += fuzz_bombs.run(Path(place))
    sys.exit(1 if total else 0)


if __name__ == "__main__":
    main()
