"""Work for the daemon's worker process: looking at images, the running estimate, replanning.

Plain functions of plain data; `pool.Workers` calls them, the daemon's loop never does.
"""
