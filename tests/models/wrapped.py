"""The contract of models for models that wrap others."""

from __future__ import annotations

from cfx.models import contract
from cfx_contracts import models

CHECKS = (
    models.every_parameter_says_what_it_is,
    contract.keeps_shape_dtype_and_device,
    contract.is_pure,
    models.a_batch_equals_the_loop_over_it,
    models.speeds_are_finite_and_not_negative_at_every_extreme,
    models.a_bad_neighbour_does_no_harm,
    models.no_rollout_leaves_what_is_finite,
)
"""What of the contract of models can hold: a first step asks nobody for the leader."""
