"""One emulated fin in the current folder: no hardware is needed.

The emulated rig starts, its drive and force zero are checked as on a real rig, and then the node of
the fin starts and moves. Write a controller first: softfin example example
"""

from launch.actions import (
    DeclareLaunchArgument,
    ExecuteProcess,
    IncludeLaunchDescription,
    RegisterEventHandler,
)
from launch.event_handlers import OnProcessExit, OnProcessIO
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

SHARE = FindPackageShare("softfin_ros")
RIG = "emulated_rig.yaml"
READY = b"runs until"
"""Part of the line that the emulated rig prints when its devices are there."""


def generate_launch_description() -> LaunchDescription:
    """Return the emulated rig; each further step starts when the one before has succeeded."""
    emulator = process("emulate", "--real-time", "--overwrite")
    check = process("check", "--prove", "--arm", "--yes")
    zero = process("zero", "--arm", "--yes")
    fin = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(PathJoinSubstitution([SHARE, "launch", "fin.launch.py"])),
        launch_arguments={
            "params_file": LaunchConfiguration("params_file"),
            "autostart": "true",
        }.items(),
    )

    def start_check(event: object) -> list[object]:
        return [check] if READY in event.text else []

    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "params_file",
                default_value=PathJoinSubstitution([SHARE, "config", "emulated_fin.yaml"]),
                description="YAML file with the parameters of the node",
            ),
            emulator,
            RegisterEventHandler(
                OnProcessIO(target_action=emulator, on_stdout=start_check, on_stderr=start_check)
            ),
            after(check, zero),
            after(zero, fin),
        ]
    )


def process(command: str, *options: str) -> ExecuteProcess:
    """Return a command for the emulated rig."""
    return ExecuteProcess(cmd=["softfin", "rig", command, "--rig", RIG, *options], output="screen")


def after(action: ExecuteProcess, following: object) -> RegisterEventHandler:
    """Return a handler that starts the following action if the process succeeds."""
    return RegisterEventHandler(
        OnProcessExit(
            target_action=action,
            on_exit=lambda event, context: [following] if event.returncode == 0 else [],
        )
    )
