"""Hardware and people: the daemon that owns a cell, its devices, the screen and the commands.

Three things are called control. *Control* alone is the right to command, which one client has at a time
(`session.take_lease`, `LeaseStatus`, `Verb.control`). The *control process* and its *control program* drive a
Universal Robots arm (`devices.ur.child`). The *control socket* is where clients connect
(`server.connections`); a path named `control` is its path, and all other sockets lie beside it.
"""
