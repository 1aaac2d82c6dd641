"""Many recordings solved, many cells collected: in processes here, or on a Dask cluster.

`run_batch(recordings, "results", workers=dask_workers(client))` solves on a `distributed.Client` that is
there already; `collect_fleet(cells, workers=…)` reads the state of every cell. Places are paths or URLs.
"""

from calibrate.batch.cluster import Cluster, cluster_workers, dask_workers
from calibrate.batch.fleet import CameraRecord, collect_fleet, fleet_table
from calibrate.batch.run import run_batch
from calibrate.batch.storage import BatchResult
from calibrate.batch.workers import BatchError, pool

__all__ = [
    "BatchError",
    "BatchResult",
    "CameraRecord",
    "Cluster",
    "cluster_workers",
    "collect_fleet",
    "dask_workers",
    "fleet_table",
    "pool",
    "run_batch",
]
