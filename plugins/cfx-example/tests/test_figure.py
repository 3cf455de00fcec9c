"""What the figure shows, and where it shows nothing."""

import cfx
import pandas as pd
from cfx.plugin import Result

from cfx_example.figure import PolicyErrors

ERRORS = pd.DataFrame(
    {
        "pair_id": ["a", "a", "b", "b"],
        "method": ["driver_specific", "policy"] * 2,
        "rmse_speed": [0.5, 0.25, 0.75, 1.0],
    }
)


def test_cfx_finds_it():
    found = cfx.get("figure", "policy_errors")
    assert found is PolicyErrors, "install it first: pip install --editable ."


def test_each_pair_is_a_point():
    figure = PolicyErrors().draw(Result(tables={"pairs": ERRORS}))
    (axes,) = figure.axes
    (points,) = axes.collections
    assert points.get_offsets().tolist() == [[0.5, 0.25], [0.75, 1.0]]


def test_a_job_without_a_policy_has_none():
    only_fixed = ERRORS[ERRORS["method"] == "driver_specific"]
    assert PolicyErrors().draw(Result(tables={"pairs": only_fixed})) is None
