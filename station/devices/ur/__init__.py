"""An arm of Universal Robots: how the station reads it, moves it and stops it by both ways.

`UrRobot` is what moves and stops the arm of a cell, a `Mover` of `station.devices.base`; its `link` is the
`Arm`, which is read. `GuidedArm` is one that a person moves while a cell is set up: it is read, and only
stopped. `TraceRecorder` records every state while a
stop is measured. `control_path` chooses what takes the moves, ur_rtde or the station's own script;
`control_trouble` says why a choice cannot be used, `library_installed` whether ur_rtde is there.

Everything else is private. Names are loaded at their first use, as the control process needs few of them.
To read the code begin with `robot`.

    robot            the driver: starts control, moves, stops by both ways (`StopPaths`)
    guided_arm       an arm that is only read, and stopped
    link             the connection that reads the arm: identity, troubles, questions to the dashboard
    state, stream    where the arm is and was; the stream that tells it (packets: `devices.rtde`)
    child, control   the control process as its parent sees it; that process
    script           control by the station's own script, where ur_rtde is missing
    moves, end_cause watch one move; find why a move or program ended
    condition        what holds the arm, in words
    dashboard, probe STOP and questions on port 29999; questions before connecting
    tool             tool centre point and payload, and whether they were changed
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
