"""A Dask cluster: the engine `dask` of a job, and Hydra's launcher `dask` of a sweep."""
