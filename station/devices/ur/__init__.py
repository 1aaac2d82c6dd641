"""An arm of Universal Robots: how the station reads it, moves it and stops it by both ways.

`UrRobot` is the arm of a cell: an `Arm` and a `Mover` of `station.devices.base`. `GuidedArm` is one that a
person moves while a cell is set up: it is read, and only stopped. `TraceRecorder` records every state while a
stop is measured. `control_path` chooses what takes the moves, ur_rtde or the station's own script;
`control_trouble` says why a choice cannot be used, `library_installed` whether ur_rtde is there.

Everything else is private. Names are loaded at their first use, as the control process needs few of them.
To read the code begin with `robot`.

    robot            the driver: starts control, moves, stops by both ways
    guided_arm       an arm that is only read, and stopped
    link             reads the arm: identity, states, questions to the dashboard
    state            its state stream (packets: `devices.rtde`)
    child, control   the control process as its parent sees it; that process
    script           control by the station's own script, where ur_rtde is missing
    moves, end_cause watch one move; find why a move or program ended
    condition        what holds the arm, in words
    dashboard, probe STOP and questions on port 29999; questions before connecting
    tool             notices another tool centre point or payload
"""

from typing import TYPE_CHECKING

from recordings.door import open_door

if TYPE_CHECKING:
    from station.devices.ur.guided_arm import GuidedArm as GuidedArm
    from station.devices.ur.robot import UrRobot as UrRobot
    from station.devices.ur.robot import control_path as control_path
    from station.devices.ur.robot import control_trouble as control_trouble
    from station.devices.ur.robot import library_installed as library_installed
    from station.devices.ur.state import TraceRecorder as TraceRecorder

__getattr__, __all__ = open_door(__name__, __file__)
