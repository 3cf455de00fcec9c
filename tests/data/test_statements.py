"""Columns of a file that say the same thing twice are compared."""

from __future__ import annotations

import numpy as np
import pytest

from cfx.data.statements import Statement, remarks_of

GENERATOR = np.random.default_rng(1)
TRUE = GENERATOR.uniform(5.0, 80.0, 500)
NOISY = TRUE * GENERATOR.normal(1.0, 0.04, 500)


def test_noise_rounding_and_empty_cells_are_no_disagreement() -> None:
    said = NOISY.copy()
    said[:50], said[50:100] = np.nan, 0.0
    assert remarks_of([Statement("dhw", said, [TRUE], "positions")]) == ()
    tiny = 0.001 * TRUE
    rounded = Statement("dhw", np.round(tiny, 2) + 0.01, [tiny], "positions", resolution=0.02)
    assert remarks_of([rounded]) == ()


def test_one_of_several_definitions_is_enough() -> None:
    assert remarks_of([Statement("dhw", NOISY, [TRUE + 20.0, TRUE], "positions")]) == ()


def test_too_few_rows_say_nothing() -> None:
    assert remarks_of([Statement("dhw", TRUE[:19] * 3.6, [TRUE[:19]], "positions")]) == ()


@pytest.mark.parametrize(
    ("factor", "units"),
    [(1 / 0.3048, "feet and metres"), (0.3048, "feet and metres"), (3.6, "km/h and m/s")],
)
def test_a_factor_between_units_is_a_contradiction(factor: float, units: str) -> None:
    (remark,) = remarks_of([Statement("dhw", NOISY * factor, [TRUE], "positions")])
    assert remark.is_contradiction
    assert units in remark.text


@pytest.mark.parametrize("said", [NOISY * 1.2, GENERATOR.permutation(TRUE)])
def test_another_definition_and_other_vehicles_are_a_doubt(said: np.ndarray) -> None:
    (remark,) = remarks_of([Statement("dhw", said, [TRUE], "positions")])
    assert not remark.is_contradiction
