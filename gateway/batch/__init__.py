"""Many recordings: solved anew, exported, reported, each as the single commands would do it.

``job`` is the work on one recording; ``manifest`` remembers what is done; ``running`` hands jobs to processes
of this machine or to a Dask cluster.
"""
