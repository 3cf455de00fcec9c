"""The contract of a demonstration, and what this one shows."""

from types import SimpleNamespace

import cfx
import pandas as pd
from cfx_contracts import check_contract

from cfx_example.demo import PAGE, Ranking


def test_contract():
    check_contract(Ranking())


def test_cfx_finds_it():
    found = cfx.get("demo", "ranking")
    assert found is Ranking, "install it first: pip install --editable ."


def test_the_best_pair_comes_first(tmp_path):
    rows = {"pair_id": ["a", "b"], "method": ["policy"] * 2, "rmse_speed": [0.5, 0.25]}
    evaluation = SimpleNamespace(table=pd.DataFrame(rows))
    Ranking().write(tmp_path, SimpleNamespace(source="made up"), None, evaluation, {})
    text = (tmp_path / PAGE).read_text()
    assert text.index("b: 0.25 m/s") < text.index("a: 0.50 m/s")
