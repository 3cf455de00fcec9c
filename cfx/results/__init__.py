"""Results of jobs: one class, `Result`, which is in memory what a job's folder holds.

`result.py` is that class, `folder.py` the folder into which it is written, `reading.py` the way
back; `table.py` and `figure.py` say what a table and a figure of a job are; `tables/` has cfx's
own tables, `config.py` a job's configuration, `tracker.py` and `mlflow/` where jobs are tracked.
"""
