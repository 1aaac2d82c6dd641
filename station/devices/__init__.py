"""Devices by maker, behind the protocols of `base`; `cell.Cell` holds those of one cell.

ur*        a Universal Robots arm: `ur` controls it, `ur_link` reads it, `ur_child` starts `ur_control`
posted     an arm that a person moves, whose pose a program posts (`posts`: its lines)
aravis*    GenICam cameras; `webcam`; `playback`: a recording as arm and camera
frames     images with their times, for every camera driver
"""
