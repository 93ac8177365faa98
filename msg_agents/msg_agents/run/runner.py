# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""A whole run: processes, bag, verdict, report."""

from __future__ import annotations

import shutil
import signal
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, nullcontext, suppress
from dataclasses import replace
from pathlib import Path

from msg_agents.channel.channel_file import Channel
from msg_agents.channel.process import open_hosts
from msg_agents.environment import (
    RESTARTS,
    ROS_LOGS,
    USER_TIMEOUT,
    require_middleware,
    run_environment,
    uses_relay,
)
from msg_agents.process_layout import (
    MOST_PROCESSES,
    MOST_UNAIDED,
    SWITCHER,
    HostAssignment,
    assign_cores,
    count_processes,
    lay_out_network,
    partners,
)
from msg_agents.recovery import entry_size, room_for
from msg_agents.run.external import ExternalAgents, robot_topics
from msg_agents.run.folder import make_bag_directory, temporary_directory
from msg_agents.run.fork_server import ForkServer
from msg_agents.run.result import EventLog, RunResult
from msg_agents.run.run_channel import RunChannel
from msg_agents.run.supervisor import CLOCKS, CRASHED, HUNG, LATE, STATUS_FOLDER, STEPS, Supervisor
from msg_agents.stepping.monitoring import (
    STUCK,
    ClockDetector,
    LagDetector,
    StallDetector,
    StuckDetector,
    silence_text,
)
from msg_agents.terminal import Interruption
from msg_agents.watch.observer import EarlyEnd
from msg_agents.watch.panel import View
from msg_agents.watch.snapshot import due_rate
from msg_analysis.bags.reading import read_bag
from msg_analysis.bags.salvage import salvage_in_place
from msg_analysis.bags.stored_file import DEFAULT_STORAGE, Storage
from msg_analysis.bags.writing import RECORDING_MARKER
from msg_analysis.common.resources import available_cores
from msg_analysis.common.text import agent_text
from msg_analysis.errors import BagError, InputError
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.model.run_record import RunRecord, Until
from msg_analysis.twin.simulate import new_record

OWN_LEASE = (  # where the middleware does not follow our profile, by which it waits an hour
    "; the lease of the DDS participants, 20 s by default, may have ended while a process was stopped or very slow: "
    "use a longer leaseDuration in your profile, or unset it"
)
FIRST_POLL, POLL = 0.02, 0.05  # s; the first until the switcher here knows of all agents


def run_network(
    experiment: Experiment,
    out: Path | None,
    *,
    domain: int | None = None,
    restarts: int = RESTARTS,
    readers: Sequence[str] = (),
    use_sim_time: bool = False,
    storage: Storage = DEFAULT_STORAGE,
    pin: bool = True,
    fork: bool = True,
    on_progress: Callable[[int], None] = lambda _: None,
    on_note: Callable[[str], None] = lambda _: None,
    view: View | None = None,
    environment: Mapping[str, str] | None = None,
    record: RunRecord | None = None,
    assignment: HostAssignment | None = None,
    channel: Channel | None = None,
    interruption: Interruption | None = None,
    until: Until | None = None,
    hung_timeout: float = HUNG,
    stuck_timeout: float = STUCK,
    robots: Path | None = None,
    external_timeout: float = USER_TIMEOUT,
) -> RunResult:
    """Run an experiment as a network of ROS 2 processes.

    To be called from the main thread, since it handles signals; the callbacks are called from there.

    Parameters
    ----------
    experiment
        what to run
    out
        directory in which a new bag is made; None: do not record
    domain
        ROS_DOMAIN_ID; None: a free one is chosen
    restarts
        how often, in all, processes of agents and the switcher are started again when they were killed (or crashed for
        the first time); one more failure ends the run. 0: no states are stored for a restart
    readers
        names of other nodes, in the same domain, that must read the states of all agents before the run starts, as
        those of a tool do that must not miss a message
    use_sim_time
        whether the nodes take the time from ``/clock``, which another process publishes in the same domain
    storage
        compression and file size of the bag
    pin
        whether each process of a run in lockstep keeps to one core, if there are more processes than cores
    fork
        whether processes are forked from one that has imported everything (Linux), and so start in a fraction of the
        time; False: each starts on its own, as a tracer such as LTTng needs
    on_progress
        called about 20 times a second, once all agents have started, with the step that every agent has reached
    on_note
        called with a line of text about each restart or stall
    view
        shows the run while it goes on; ``on_progress`` and ``on_note`` are then not called
    environment
        changes to the environment of the processes
    record
        record of the run; None: a new one is made
    assignment
        what this host runs, of several hosts; None: all. Without the recorder only the logs are kept, in the
        directory that would hold the bag
    channel
        the hosts on which the processes are, and what is between them; None: all are on this one
    until
        when the run may end before its duration, in order, as a complete run of fewer steps; None: it does not. Not
        with an ``assignment``
    interruption
        keeps signals from the start of the processes on, beyond the end of this call; None: one for this call only
    hung_timeout
        s without running after which a process whose main thread waits is ended and started again
    stuck_timeout
        s without a step after which the run ends, on one machine, although all of its processes run
    robots
        map file of the external agents, which are then robots with topics; None: the user starts them as nodes
    external_timeout
        s that external agents have to come, and to make a step

    Returns
    -------
    RunResult
        The result, without comparison. ``failures`` is empty if every process did its part.

    Raises
    ------
    NotAvailableError, InputError
        the experiment cannot be run, no domain is free, or rights for a channel are missing; nothing was started, and
        no bag or log is left
    """
    view = view or View(on_progress, on_note)
    experiment.require_available()
    external = ExternalAgents(experiment, robot_topics(experiment, robots) if robots else {}, external_timeout)
    own_observer = assignment is None and not (experiment.external and robots is None)  # whether all states are here
    if until and not own_observer:
        raise InputError(f"--until {until}: not with external agents without --map: their states are not known here")
    if channel and experiment.external:
        raise InputError("--channel: not with external agents: other programs do not reach its hosts")
    most = MOST_PROCESSES if channel is None and uses_relay(environment or {}) else MOST_UNAIDED
    count = count_processes(experiment, None if assignment is None else len(assignment.agents), most=most)
    directory = make_bag_directory(experiment, out.absolute()) if out is not None else None
    bag = directory if assignment is None or assignment.has_recorder else None
    result = RunResult(experiment, bag)
    signals = interruption or Interruption()
    try:
        with (
            open_hosts(list(channel.hosts), channel.mtu) if channel else nullcontext() as opened,
            temporary_directory() as folder,
            ExitStack() as stack,
        ):
            linked = RunChannel(channel, opened) if channel and opened else None
            changes = {**(environment or {}), **(linked.environment(folder) if linked else {})}
            domain, variables, relay = stack.enter_context(run_environment(folder, domain, changes, count + 2))
            with ForkServer(variables, folder / "fork_server.log") if fork else nullcontext() as fork_server:
                require_middleware(variables, *([fork_server.has_middleware] if fork_server else []))
                if assignment is None and linked is None:  # tools of the user do not reach a channel
                    view.joined(domain)
                record = replace(record or new_record(experiment), until=until)
                run_file = folder / "run.json"
                run_file.write_text(record.to_json(with_key=True), encoding="utf-8")
                signals.keep()
                with (
                    temporary_directory(experiment.agents * room_for(entry_size(record)))
                    if restarts or until
                    else nullcontext() as checkpoints,
                    Supervisor(
                        folder,
                        variables,
                        last_step=experiment.steps,
                        fork_server=fork_server,
                        relay=relay,
                        hung_timeout=hung_timeout,
                        ends_hung=assignment is None,  # with several hosts, the switcher waits for others at its end
                    ) as supervisor,
                ):
                    processes = lay_out_network(
                        experiment,
                        run_file,
                        bag,
                        checkpoints=checkpoints,
                        use_sim_time=use_sim_time,
                        storage=storage,
                        assignment=assignment,
                        readers=readers,
                        most=MOST_PROCESSES if relay else MOST_UNAIDED,
                        hosts=linked.agents if linked else (),
                        robots=robots and robots.absolute(),
                        external_timeout=external_timeout,
                    )
                    lockstep = experiment.run.pace == "lockstep"
                    if linked:
                        linked.start(supervisor, processes, record.model, lockstep=lockstep)
                    if relay:
                        relay.connect(partners(processes, record.model.listens()))
                    if pin and lockstep:
                        supervisor.cores = assign_cores(processes, available_cores(), first=domain)
                    supervisor.start(processes)
                    ending = EarlyEnd(record, checkpoints) if until and checkpoints else None
                    with ending or nullcontext():
                        view.begin(record, checkpoints if own_observer else None, ending.observer if ending else None)
                        view.started(supervisor.by_node)
                        if SWITCHER in supervisor.by_node and (words := external.how_to_start(run_file, domain)):
                            view.note(words)
                        parts = supervisor, result, restarts, signals, view, ending, linked, external
                        # Across hosts, and over links that are cut, others know better whether somebody is waited for.
                        alone = assignment is None and linked is None
                        stuck = StuckDetector(stuck_timeout) if alone else None
                        advice = "" if uses_relay(environment or {}) else OWN_LEASE
                        _watch(*parts, follow_clock=not use_sim_time, stuck=stuck, advice=advice)
                        view.end()
                    result.until = ending.to_json() if ending else None
                    # Before the supervisor ends the rest: what ends because we end it has not failed.
                    _collect_failures(supervisor, result, signals, restarts, external)
                    if result.failures and not result.interrupted:
                        supervisor.drain()
            result.rejected_messages = supervisor.status().rejected_messages()
            result.clocks, _ = supervisor.clocks()
            if linked:
                result.channel = linked.to_json(supervisor, experiment)
            if bag is not None:
                try:
                    with signals.let_through():
                        _settle(bag, result)
                except KeyboardInterrupt:
                    result.interrupt(signal.SIGINT, "while the bag was read")
            if directory is not None:
                _keep_logs(folder, directory / "log", result)
        if (number := signals.take()) is not None and not result.interrupted:
            result.interrupt(number, "while the logs were kept")
    finally:
        if interruption is None:
            signals.end()
        if directory is not None:
            with suppress(OSError):
                directory.rmdir()  # if it is empty
    return result


def _watch(
    supervisor: Supervisor,
    result: RunResult,
    restarts: int,
    signals: Interruption,
    view: View,
    ending: EarlyEnd | None,
    linked: RunChannel | None,
    external: ExternalAgents,
    *,
    follow_clock: bool,  # whether the nodes' clock is that of this machine
    stuck: StuckDetector | None,
    advice: str,  # what is added when it is stuck
) -> None:
    """Watch until all have done their part, one has failed for good, or a signal has ended the run."""
    began: float | None = None
    stall, steps, run = StallDetector(), result.experiment.steps, result.experiment.run
    due = due_rate(result.experiment)  # steps per second in real time
    lag, clock = (LagDetector(due), ClockDetector()) if run.pace == "realtime" and follow_clock else (None, None)
    events, warned = EventLog(result.events), None
    will_begin = SWITCHER in supervisor.by_node  # with several hosts, one has it; the others do not know
    while signals.caught is None and _revive(supervisor, result, restarts, view, events) and supervisor.awaited:
        if linked:
            linked.look(supervisor)
        time.sleep(FIRST_POLL if will_begin and began is None else POLL)
        supervisor.read_status()
        if ending and ending.look(min(supervisor.steps, default=-1), view.note):
            supervisor.last_step = steps = ending.last_step
            view.ends_at(steps)
        events.look(supervisor.steps, supervisor.status)
        if not warned and (warned := supervisor.clocks()[1]):
            view.note(warned)
        view.look(supervisor.steps)
        for name in supervisor.dismiss_late():
            view.note(f"{name} had not left {LATE:g} s after the end of the run: interrupted")
        reached = min(supervisor.steps, default=-1)
        if clock and (words := clock.update()):
            view.note(words)
            lag = LagDetector(due)
        if stall.update(sum(supervisor.steps)) and reached >= 0:
            view.note(f"{_still(reached < steps, stall.stalled)}: {supervisor.stall_causes(result.experiment.names)}")
        for line in external.notes(lambda: supervisor.status().waiting):
            view.note(line)
        if words := external.failure(supervisor.steps, steps):
            result.failures.append(words)
            return
        excused = run.pace == "realtime" and 0 <= reached < steps  # its clock may stand still
        excused |= external.holds_up(supervisor.steps, steps)
        excused |= stall.stalled > 1.0 and bool(supervisor.silent)
        if stuck and stuck.update(sum(supervisor.steps), excused=excused):
            causes = supervisor.stall_causes(result.experiment.names)
            result.failures.append(
                f"{_still(reached < steps, stuck.limit)} at step {reached}, though all processes run: messages do not "
                f"arrive any more: {causes}: run it again{advice}"
            )
            return
        if reached < 0:
            continue
        if lag and reached < steps and (late := lag.update(supervisor.steps, steps)):
            others, names = len(supervisor.steps) - len(late.silent), result.experiment.names
            view.note(
                silence_text(late.silent, late.quiet, others, supervisor.pids, names)
                if late.silent
                else f"the network cannot keep up: it is {late.behind:.1f} s behind the {due:g} steps/s of real time: "
                f"lower `run: speed: {run.speed:g}`, or give several agents to one process (`run: processes`)"
            )
        now = time.monotonic()
        began = began or now
        if reached < steps or not result.wall_time:
            result.wall_time = now - began
    supervisor.read_status()  # what was reported between the last look and the end
    events.look(supervisor.steps, supervisor.status, last=True)
    view.look(supervisor.steps)
    if result.wall_time:
        result.rate = min(supervisor.steps, default=0) / result.wall_time


def _still(steps_are_left: bool, seconds: float) -> str:
    return f"{'no step' if steps_are_left else 'all steps are made, but no end'} for {seconds:.0f} s"


def _revive(supervisor: Supervisor, result: RunResult, restarts: int, view: View, events: EventLog) -> bool:
    """Start killed processes again; False if one cannot be."""
    for child in supervisor.failures:
        if not child.resumes or len(result.restarts) >= restarts:
            return False
        step = min((supervisor.steps[i] for i in child.spec.agents), default=-1) if supervisor.steps else -1
        after = f" after step {step}" if step >= 0 else ""
        words = f" ({child.last_line()})" if child.process.poll() in CRASHED else ""
        result.restarts.append(f"{child.spec.name}: {child.failure}{words}{after}, started again")
        events.killed(child.spec.name, child.spec.agents, step, result.restarts[-1])
        view.note(result.restarts[-1])
        supervisor.restart(child)
        view.started(supervisor.by_node)
    return True


def _collect_failures(
    supervisor: Supervisor, result: RunResult, interruption: Interruption, restarts: int, external: ExternalAgents
) -> None:
    result.reached = min(supervisor.steps, default=-1)
    if (number := interruption.take()) is not None:
        reached, steps = result.reached, result.experiment.steps
        unknown = all(child.spec.name != SWITCHER for child in supervisor.children)  # it is on another host
        where = "" if unknown else f"at step {reached} of {steps}" if reached >= 0 else "before step 0"
        result.interrupt(number, where)
    if words := external.not_discovered(child.last_line() for child in supervisor.failures):
        result.failures.append(words)  # the others have failed for that
        return
    for child in supervisor.failures:
        words = child.last_line()
        whose = " (external)" if child.spec.external else ""
        line = f"{child.spec.name}{whose}: {child.failure}" + (f": {words}" if words else "")
        if result.bag and child.has_traceback():
            line += f"; traceback in log/{child.log.name}"
        if child.resumes and result.restarts:
            counts = {c.spec.name: c.number - 1 for c in supervisor.children if c.number > 1}
            listed = ", ".join(
                f"{name} {times} times" if times > 1 else f"{name} once" for name, times in counts.items()
            )
            line += f". Not started again: all restarts are used up (--restarts {restarts}): {listed}"
        result.failures.append(line)


def _keep_logs(folder: Path, directory: Path, result: RunResult) -> None:
    try:
        unwanted = shutil.ignore_patterns(STATUS_FOLDER, STEPS, CLOCKS, ROS_LOGS, ".*")  # hidden: drafts
        shutil.copytree(folder, directory, ignore=unwanted)
    except OSError as error:
        # The argument of shutil.Error is a list of (from, to, reason).
        reason = error.args[0][0][2] if isinstance(error, shutil.Error) else str(error)
        shutil.rmtree(directory, ignore_errors=True)
        result.not_kept.append(f"{directory}: {reason}")


def _settle(bag: Path, result: RunResult) -> None:
    """Salvage the bag if its recorder did not close it, read it, and say how far each agent came."""
    try:
        if (bag / RECORDING_MARKER).exists():
            report = salvage_in_place(bag)
            result.failures.append(f"the bag was salvaged: {report.kept_messages} messages kept")
        if result.failures and not any(bag.glob("*.mcap")):
            result.failures.append("nothing was recorded: the run ended before the recorder created a bag")
            return
        if result.interrupted:  # whoever has stopped the run does not want to wait
            return
        result.trajectory = read_bag(bag)
    except BagError as error:
        result.failures.append(str(error))
        return
    if result.failures:
        names = result.experiment.names
        last = [
            int(steps[-1]) if (steps := present.nonzero()[0]).size else -1 for present in result.trajectory.present.T
        ]
        result.failures.append(
            "last recorded step: "
            + ", ".join(f"{agent_text(i, names)}: {k if k >= 0 else 'none'}" for i, k in enumerate(last, start=1))
        )
