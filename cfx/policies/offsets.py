"""Answers as offsets from base parameters.

A network that answers offsets is asked, for each driver, to move away from parameters that are already good for him: his own
fixed set, or the population's. Its answer in unit space, 1/2 meaning no offset, is added to the base in the squashed space (on
logits), so that an untrained network *is* the base and no answer leaves the bounds.
"""

from __future__ import annotations

import torch
from torch import Tensor

from cfx.parameters import ParameterSpace

NONE = 0.5
"""The answer that leaves the base as it is."""

_EDGE = 0.005
"""How close to a bound, in unit space, a base counts as being when it is moved: at the bound itself no offset would move it."""

_LARGEST = 1e-6

_GAIN = 3.0
"""How many times an answer's logit counts. Networks begin with small outputs, and models with parameters far from the middle of
their bounds (Wiedemann 99) need large offsets: without this they train three times as long to reach them."""


def coordinates(base: Tensor) -> Tensor:
    """Returns the base in the squashed space: logits `(*batch, n)` of unit-space values `(*batch, n)`; finite at the bounds."""
    return torch.logit(base.clamp(_EDGE, 1.0 - _EDGE))


def drawn(space: ParameterSpace, own: Tensor, shrinkage: float) -> Tensor:
    """Returns drivers' own parameters drawn towards the model's default in the squashed space; both `(*batch, n)` in SI units.

    A set of ten parameters fitted to one minute of driving holds much that is chance. As the starting point for offsets it does
    better when it is drawn towards what is known beforehand, as estimates of many small groups do (shrinkage: W. James and
    C. Stein, 1961, *Estimation with quadratic loss*, Proc. 4th Berkeley Symposium).

    Args:
        space: the model's parameters.
        own: the sets.
        shrinkage: 0: exactly the sets; 1: the default.
    """
    if shrinkage == 0:
        return own
    default = space.defaults(dtype=own.dtype, device=own.device)
    one, other = (coordinates(space.to_unit(values)) for values in (own, default.expand_as(own)))
    return space.from_unit(torch.sigmoid(torch.lerp(one, other, shrinkage)))


def moved(base: Tensor, answer: Tensor, free: Tensor | None = None) -> Tensor:
    """Returns the base moved by an answer, both `(*batch, n)` in unit space; exactly the base where the answer is 1/2.

    A base within 0.5 % of a bound is moved as if it were that far from it, and the difference kept.

    Args:
        base: where offsets start.
        answer: of a network.
        free: which parameters may be moved, bool `(n,)`; None: all.
    """
    if free is not None:
        answer = torch.where(free, answer, NONE)
    inner = base.clamp(_EDGE, 1.0 - _EDGE)
    logit = torch.logit(inner)
    step = torch.sigmoid(logit + _GAIN * torch.logit(answer, eps=_LARGEST)) - torch.sigmoid(logit)
    return (base + step).clamp(0.0, 1.0)
