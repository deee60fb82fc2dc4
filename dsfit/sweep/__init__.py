"""Sweeps: thousands of variants of one config, on the cores of this machine or on those of a Dask cluster.

`plan` says which cells there are, `compute` makes one of them, `child` is the process that does so and `slot` its
keeper, `executors` are where slots are, `drive` hands out cells and takes results, `log` keeps what is done, `table`
makes `results.parquet` of it.
"""
