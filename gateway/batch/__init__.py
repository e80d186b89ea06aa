"""Many recordings: solved anew, exported, reported, each as the single commands would do it.

``job`` is the work on one recording; ``manifest`` remembers what is done; ``running`` hands jobs to processes
of this machine or to a Dask cluster.
"""

from gateway.batch.job import Job, Outcome, Task, perform
from gateway.batch.manifest import Manifest
from gateway.batch.running import jobs_in, run_jobs

__all__ = ["Job", "Manifest", "Outcome", "Task", "jobs_in", "perform", "run_jobs"]
