"""One job, from the data to the figures.

A dataset gives pairs. An optimizer calibrates a driving model on them. A learner trains a policy
on the result. A protocol evaluates it. Tracking keeps what came out.

`steps` makes the components, `run` takes the steps, `results` writes the folder and reads it back,
and `console` prints the table.
"""
