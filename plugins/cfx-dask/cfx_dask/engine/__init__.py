"""The engine `dask`: shards run on a Dask cluster. Dask is imported when it is used."""
