"""Devices by maker, behind the protocols of `base`; `cell.Cell` holds those of one cell.

An arm of Universal Robots, which the station moves
    ur                     the driver, a room of its own
    robot_lock, rtde       one station for an arm on this computer; packets of its state stream
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
