"""Devices by maker, behind the protocols of `base`; `cell.Cell` holds those of one cell.

An arm of Universal Robots, which the station moves
    ur                     the driver: starts control, moves, stops by both ways
    ur_link                reads the arm: identity, states, questions to the dashboard
    robot_lock             one station for an arm on this computer
    ur_state, rtde         its state stream; packets of that stream
    ur_child, ur_control   the control process as its parent sees it; that process
    ur_script              control by the station's own script, where ur_rtde is missing
    ur_moves, ur_end_cause watch one move; find why a move or program ended
    ur_condition           what holds the arm, in words
    ur_dashboard, ur_probe STOP and questions on port 29999; questions before connecting
    ur_tool                notices another tool centre point or payload
An arm that a person moves
    posted, posts          its pose, posted by a program; lines of that program
Cameras
    aravis*, genicam_settings, discovery    GenICam cameras
    webcam                 cameras of the operating system
    serial_trigger         box that triggers a camera
    frames                 images with their times, for every camera driver
Shared
    news, history          how late states may be; the state of a moment
    clocks                 a device's clock against this computer's
    playback               a recording as arm and camera
"""
