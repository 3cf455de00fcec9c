"""Compiled accumulation: a rollout whose losses are summed up step by step, without trajectories.

A driving model is defined once, as a function of tensors. `graph` records the elementwise
operations of one of its steps and of an objective's terms, `columns` what a model's memory takes
part in; `source` writes them as a C++ loop over candidates, with the time outside and the
candidates in vector registers inside; `compiler` builds it once and keeps it; `run` feeds it with
tensors. A model that does something which is not elementwise has no such kernel and is simulated by
PyTorch. `recording` and `rows` make one loop of any elementwise function of rows of tables.
"""
