# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Acceptance tests of anything that has one number per run: repeated until it is known how often it is good."""

from __future__ import annotations

import fcntl
import json
import math
import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal
from xml.etree import ElementTree

import numpy as np

from msg_analysis.common.files import lock, read_text, write_whole
from msg_analysis.common.text import json_text, percent
from msg_analysis.errors import InputError
from msg_analysis.inference.e_values import share_evidence

Decision = Literal["accepted", "rejected", "open"]
MOST_IN_FILE = 1_000_000  # runs


@dataclass(frozen=True, slots=True)
class Claim:
    """In at least ``in_share`` of all runs the metric is within its bounds."""

    name: str
    at_least: float | None
    at_most: float | None
    in_share: float
    margin: float
    level: float

    def __post_init__(self) -> None:
        bounds = [bound for bound in (self.at_least, self.at_most) if bound is not None]
        if not bounds or any(not math.isfinite(bound) for bound in bounds) or bounds != sorted(bounds):
            raise InputError(f"at_least, at_most: {self.at_least}, {self.at_most}: expected one or both, ascending")
        if not 0.0 < self.in_share < 1.0:
            raise InputError(f"in_share: {self.in_share}: expected a share above 0, below 1: for example 0.95")
        if not 0.0 < self.margin < self.in_share:
            raise InputError(f"margin: {self.margin}: expected above 0, below in_share: for example 0.05")
        if not 0.0 < self.level <= 0.5:
            raise InputError(f"level: {self.level}: expected above 0, at most 0.5: for example 0.01")

    def holds(self, value: float) -> bool:
        """Whether a value is good; nan, a run that has none, is not."""
        low, high = -math.inf if self.at_least is None else self.at_least, self.at_most
        return low <= value <= (math.inf if high is None else high)

    @property
    def words(self) -> str:
        """What is claimed."""
        low = None if self.at_least is None else f"at least {self.at_least:g}"
        high = None if self.at_most is None else f"at most {self.at_most:g}"
        return f"{self.name} {' and '.join(filter(None, (low, high)))} in {percent(self.in_share)} of the runs"


@dataclass(frozen=True, slots=True)
class Acceptance:
    """What is known of a claim.

    Attributes
    ----------
    claim
        what was asked
    values
        one per run, in order, those of earlier calls from the file included
    """

    claim: Claim
    values: tuple[float, ...]

    @property
    def good(self) -> int:
        """Number of runs whose value is within the bounds."""
        return sum(map(self.claim.holds, self.values))

    @property
    def decision(self) -> Decision:
        """The first one that the runs have proved: "rejected", "accepted"; "open" where none is yet."""
        claim, holds = self.claim, np.array([self.claim.holds(value) for value in self.values], dtype=np.int64)
        good, bad = np.cumsum(holds), np.cumsum(1 - holds)
        below = share_evidence(good, bad, claim.in_share)
        above = share_evidence(bad, good, 1.0 - claim.in_share + claim.margin)
        known = np.flatnonzero(np.maximum(below, above) >= -math.log(claim.level))
        if not len(known):
            return "open"
        return "rejected" if below[known[0]] >= above[known[0]] else "accepted"

    @property
    def words(self) -> str:
        """The decision, and why, in a sentence."""
        claim, runs, good = self.claim, len(self.values), self.good
        share = f"{good} of {runs} runs ({percent(good / max(1, runs))})"
        reason = {
            "accepted": f"the share is above {percent(claim.in_share - claim.margin)}",
            "rejected": f"the share is below {percent(claim.in_share)}",
            "open": "not known yet: more runs are needed",
        }
        sure = f", at level {percent(claim.level)}" * (self.decision != "open")
        return f"{self.decision}: {claim.words}: {share}; {reason[self.decision]}{sure}"

    def __str__(self) -> str:
        rows = [f"{'run':>6}  {self.claim.name:>12}  good"]
        shown = list(enumerate(self.values, start=1))
        shown = [row for row in shown if not self.claim.holds(row[1])][-20:] or shown[-20:]
        rows += [f"{run:>6}  {value:>12g}  {'yes' if self.claim.holds(value) else 'no'}" for run, value in shown]
        return "\n".join([self.words, *rows])

    def to_junit(self) -> bytes:
        """A JUnit document with one test, which fails if the claim is rejected and is skipped while it is open."""
        decision = self.decision
        counts = {"tests": "1", "failures": str(int(decision == "rejected")), "skipped": str(int(decision == "open"))}
        suite = ElementTree.Element("testsuite", {"name": "acceptance", **counts})
        case = ElementTree.SubElement(suite, "testcase", {"classname": "acceptance", "name": self.claim.words})
        if decision != "accepted":
            kind = "failure" if decision == "rejected" else "skipped"
            ElementTree.SubElement(case, kind, {"message": self.words})
        ElementTree.SubElement(case, "system-out").text = str(self)
        return bytes(ElementTree.tostring(suite, encoding="utf-8", xml_declaration=True))


def accept(
    metric: Callable[[], float] | Iterable[float],
    *,
    at_most: float | None = None,
    at_least: float | None = None,
    in_share: float = 0.95,
    margin: float = 0.05,
    level: float = 0.01,
    most: int = 100,
    name: str = "metric",
    state: str | Path | None = None,
    revision: str | None = None,
    junit: str | Path | None = None,
) -> Acceptance:
    """Repeat a run until it is known whether its metric is within bounds in a share of all runs; fail if it is not.

    Tests after every run, so it ends as early as the runs allow: a claim that holds is ever rejected with probability
    at most ``level``, and one whose share is less than ``in_share - margin`` is ever accepted with at most that, too
    (test martingales, Ville's inequality). Between the two either may happen. Runs must be independent.

    Parameters
    ----------
    metric
        makes a run and returns its number, nan if it has none (which is not good); or numbers, one per run
    at_most, at_least
        bounds of a good number, of which one is needed
    in_share, margin, level
        see above
    most
        runs of this call; then it ends, still "open"
    name
        of the metric, in words and tables
    state
        a file (JSON) in which the runs are kept from call to call; one for each claim. Each run is in it before the
        next begins, and calls at the same time add up
    revision
        of what is tested, such as a commit: runs of another one in the file do not count and are replaced
    junit
        a JUnit file (XML) to write

    Returns
    -------
    Acceptance
        ``decision`` "accepted" or "open", ``values``, a table as text

    Raises
    ------
    AssertionError
        rejected; its text is the table
    InputError
        an argument that is not valid, or a file that is not one of this claim
    """
    claim = Claim(name, at_least, at_most, in_share, margin, level)
    if most < 1:
        raise InputError(f"most: {most}: expected a number of runs from 1")
    file = None if state is None else Path(state)
    found = Acceptance(claim, _earlier(file, claim, revision) if file else ())
    numbers = _numbers(metric)
    for _ in range(most):
        if found.decision != "open":
            break
        value = next(numbers, None)
        if value is None:
            break
        number = _number(value, name)
        if file:
            found = Acceptance(claim, _kept(file, claim, revision, number))
        else:
            found = Acceptance(claim, (*found.values, number))
    if junit is not None:
        write_whole(Path(junit), found.to_junit())
    if found.decision == "rejected":
        raise AssertionError(str(found))
    return found


def _numbers(metric: Callable[[], float] | Iterable[float]) -> Iterator[float]:
    if callable(metric):
        while True:
            yield metric()
    yield from metric


def _number(value: Any, name: str) -> float:
    try:
        return float(value)
    except (TypeError, ValueError):
        raise InputError(f"{name}: {value!r}: expected a number per run, or nan") from None


def _document(claim: Claim) -> dict[str, Any]:
    return {key: getattr(claim, key) for key in claim.__slots__}


def _written(value: float) -> float | str:
    """JSON has no numbers that are not finite."""
    return value if math.isfinite(value) else str(value)


def _kept(file: Path, claim: Claim, revision: str | None, number: float) -> tuple[float, ...]:
    """Add a run to the file, after those that other calls have added meanwhile; all of them."""
    folder = os.open(file.parent, os.O_RDONLY)
    try:
        lock(folder, fcntl.LOCK_EX, file)  # of the folder, since the file is replaced
        values = (*_earlier(file, claim, revision), number)
        document = {"claim": _document(claim), "revision": revision, "values": list(map(_written, values))}
        write_whole(file, json_text(document, 1).encode() + b"\n")
    finally:
        os.close(folder)
    return values


def _earlier(file: Path, claim: Claim, revision: str | None) -> tuple[float, ...]:
    """The runs of earlier calls; InputError: a file that cannot be read, or of another claim."""
    try:
        document = json.loads(read_text(file))
        values = tuple(float(value) for value in document["values"][:MOST_IN_FILE])
        same, before = document["claim"] == _document(claim), document["revision"]
    except FileNotFoundError:
        return ()
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{file}: not a state of `accept` ({error}): expected its file: give another one") from error
    if not same:
        wanted = f"expected one of this claim, {claim.words}: give another file, or remove it to begin anew"
        raise InputError(f"{file}: a state of another claim: {wanted}")
    return values if before == revision else ()
