"""Work of the daemon's worker process: board detection, running estimate, checks of plans.

Plain functions of plain data, called through `pool.Workers`, never in the daemon's event loop.
"""
