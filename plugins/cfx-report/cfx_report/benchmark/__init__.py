"""`cfx benchmark`: one frozen protocol, so that models and policies of different people compare.

`frozen` is what nobody may change; `run` makes a row by one job, `compare` sets it beside another's
errors pair by pair, `table` writes rows as Markdown.
"""
