# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Actions of ``launch`` for the decisions of ``run/launch.py``. Only the launch files import this."""

from __future__ import annotations

import signal
from collections.abc import Mapping
from typing import Any

from launch import LaunchDescription
from launch.action import Action
from launch.actions import (
    DeclareLaunchArgument,
    EmitEvent,
    ExecuteProcess,
    LogInfo,
    OpaqueFunction,
    RegisterEventHandler,
    TimerAction,
)
from launch.event_handlers import OnProcessExit, OnShutdown
from launch.events import Shutdown, matches_action
from launch.events.process import ProcessExited, ShutdownProcess, SignalProcess
from launch.launch_context import LaunchContext
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.substitutions import ExecutableInPackage

from msg_agents.run.launch import ANALYSIS, LaunchedProcesses, LaunchFailedError, check_names, environment, flag

GRACE = 20.0  # s that a process has to end


def describe(arguments: Mapping[str, tuple[str, str]], start: Any) -> LaunchDescription:
    """The description of a launch file: arguments, with default and description, and what ``start`` makes of them."""

    def begin(context: LaunchContext) -> list[Action]:
        check_names(context, list(arguments))
        values = {name: LaunchConfiguration(name).perform(context) for name in arguments}
        shutdown = flag(values, "shutdown")
        return _Group(start(values), shutdown=shutdown).actions()  # an exception: the exit code of launch is 1

    declared = [
        DeclareLaunchArgument(name, default_value=default, description=description)
        for name, (default, description) in arguments.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=begin)])


class _Group:
    """Processes that are started together; other ones of the same launch are left alone, unless ``shutdown``."""

    def __init__(self, launched: LaunchedProcesses, *, shutdown: bool) -> None:
        self._launched = launched
        self._shutdown = shutdown
        self._nodes: dict[str, ExecuteProcess] = {}
        self._timers: list[TimerAction] = []

    def actions(self) -> list[Action]:
        """What starts them, and follows their ends."""
        for spec in self._launched.processes:
            self._nodes[spec.name] = Node(
                package="msg_agents",
                executable=spec.arguments[0],
                arguments=list(spec.arguments[1:]),
                namespace=self._launched.namespace or None,
                exec_name=spec.name,
                additional_env=environment(),
                output="screen",
            )
        handlers = [self._at_end_of(name, node) for name, node in self._nodes.items()]
        return [RegisterEventHandler(OnShutdown(on_shutdown=self._on_shutdown)), *handlers, *self._nodes.values()]

    def _at_end_of(self, name: str, process: ExecuteProcess) -> Action:
        def on_exit(event: ProcessExited, context: LaunchContext) -> list[Action]:
            first = self._launched.reason is None
            self._launched.ended(name, event.returncode)
            return self._next(context, failed=first and self._launched.reason is not None)

        return RegisterEventHandler(OnProcessExit(target_action=process, on_exit=on_exit))

    def _next(self, context: LaunchContext, *, failed: bool) -> list[Action]:
        """What follows the end of a process; ``failed``: it is the first one to fail."""
        launched = self._launched
        if not launched.over:
            if context.is_shutdown:  # launch stops them itself
                return []
            said = [LogInfo(msg=f"{launched.reason}: stopping the other processes")] if failed else []
            return said + [action for name in launched.to_stop() for action in self._stop(self._nodes[name])]
        if (arguments := launched.analysis()) is not None:
            analysis = ExecuteProcess(
                cmd=[ExecutableInPackage(executable="msg-analysis", package="msg_analysis"), *arguments],
                output="screen",
            )
            return [LogInfo(msg=f"the run is complete: {arguments[1]}"), self._at_end_of(ANALYSIS, analysis), analysis]
        launched.close()
        for timer in self._timers:
            timer.cancel()
        if launched.reason is not None and (self._shutdown or context.is_shutdown):
            return [self._failure()]
        return [EmitEvent(event=Shutdown(reason="all is done"))] if self._shutdown else []

    def _stop(self, node: ExecuteProcess) -> list[Action]:
        """SIGTERM, later SIGKILL. A Python that starts takes SIGINT, which launch would send, with a traceback."""
        if "pid" not in node.process_details:  # launch sends what it has to when it is there
            return [EmitEvent(event=ShutdownProcess(process_matcher=matches_action(node)))]
        signals = [
            EmitEvent(event=SignalProcess(signal_number=number, process_matcher=matches_action(node)))
            for number in (signal.SIGTERM, signal.SIGKILL)
        ]
        self._timers.append(TimerAction(period=GRACE, actions=signals[1:], cancel_on_shutdown=False))
        return [signals[0], self._timers[-1]]

    def _on_shutdown(self, event: Shutdown, _: LaunchContext) -> list[Action]:
        if not self._launched.over:
            self._launched.interrupted("stopped by Ctrl-C" if event.due_to_sigint else f"stopped: {event.reason}")
        elif self._launched.reason is not None:
            return [self._failure()]
        return []

    def _failure(self) -> Action:
        """The last error that launch prints, and a failure as its exit code."""
        # As an event of its own: an exception keeps other handlers from seeing the event that it is raised for.

        def fail(_: LaunchContext) -> None:
            raise LaunchFailedError(self._launched.reason)

        return TimerAction(period=0.0, actions=[OpaqueFunction(function=fail)], cancel_on_shutdown=False)
