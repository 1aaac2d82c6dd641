"""Many recordings solved: in processes here, or on a Dask cluster.

`run_batch(recordings, Path("results"), workers=dask_workers(client))` solves on a `distributed.Client` that
is there already.
"""

from calibrate.batch.cluster import cluster_workers, dask_workers
from calibrate.batch.run import BatchResult, run_batch
from calibrate.batch.workers import BatchError, pool

__all__ = ["BatchError", "BatchResult", "cluster_workers", "dask_workers", "pool", "run_batch"]
