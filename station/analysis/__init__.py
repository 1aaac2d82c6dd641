"""Work for the daemon's worker process: looking at images, the running estimate.

Plain functions of plain data; `pool.Workers` calls them, the daemon's loop never does.
"""
