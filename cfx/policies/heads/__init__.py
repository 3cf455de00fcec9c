"""Parameter heads: how answers of networks become parameters.

A new head is a file here and a line below.
"""

from __future__ import annotations

from cfx.policies.heads.base import ParameterHead
from cfx.policies.heads.direct import DirectHead
from cfx.policies.heads.direct_residual import DirectResidualHead
from cfx.policies.heads.offset import OffsetHead
from cfx.policies.heads.residual import ResidualHead
from cfx.policies.heads.stochastic import StochasticHead

HEADS: dict[str, type[ParameterHead]] = {
    DirectHead.name: DirectHead,
    OffsetHead.name: OffsetHead,
    ResidualHead.name: ResidualHead,
    DirectResidualHead.name: DirectResidualHead,
    StochasticHead.name: StochasticHead,
}
"""Heads by the names that saved policies give."""


def head_name(*, has_base: bool) -> str:
    """Returns the head of a learner's result that names none."""
    if has_base:
        return OffsetHead.name
    return DirectHead.name
