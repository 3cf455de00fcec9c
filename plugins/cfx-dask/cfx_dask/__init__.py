"""Sweeps on a Dask cluster: Hydra's launcher `dask`."""
