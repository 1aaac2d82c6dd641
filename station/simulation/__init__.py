"""A simulated cell: `launch_cell.py` makes it, `controller` answers as a UR's, `camera.py` sees a board."""
