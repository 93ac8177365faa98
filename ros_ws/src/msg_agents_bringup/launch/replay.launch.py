"""Publish a recorded network again, and watch it.

ros2 launch msg_agents_bringup replay.launch.py bag:=runs/line_ring_20260114_083441 rate:=max
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, EmitEvent, OpaqueFunction, RegisterEventHandler
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from msg_agents.running.launch_support import REPLAY_ARGUMENTS, LaunchFailedError, replay_commands


def generate_launch_description():
    arguments = [
        DeclareLaunchArgument(name, default_value=default, description=description)
        for name, (default, description) in REPLAY_ARGUMENTS.items()
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=start)])


def start(context):
    """The player and, if requested, `live`; the launch ends when both have ended."""
    arguments = {name: LaunchConfiguration(name).perform(context) for name in REPLAY_ARGUMENTS}
    commands = replay_commands(arguments)
    running = {executable for executable, _ in commands}
    actions = []

    def ending(executable):
        def on_exit(event, context):
            running.discard(executable)
            if event.returncode and not context.is_shutdown:
                raise LaunchFailedError(f"{executable}: exit code {event.returncode}")
            return None if running else [EmitEvent(event=Shutdown(reason="the replay is over"))]

        return on_exit

    for executable, words in commands:
        node = Node(
            package="msg_agents",
            executable=executable,
            arguments=words,
            namespace=arguments["namespace"] or None,
            output="screen",
        )
        actions += [node, RegisterEventHandler(OnProcessExit(target_action=node, on_exit=ending(executable)))]
    return actions
