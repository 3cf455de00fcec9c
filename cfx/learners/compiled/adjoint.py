"""Derivatives of recorded elementwise code, statement by statement: reverse-mode differentiation.

Each statement `r = operation(x, y)` adds to the derivatives by its operands: with d_r the
derivative of the result by r, x receives `d_r * dr/dx` (A. Griewank and A. Walther, 2008,
*Evaluating Derivatives*, second edition, section 3.2). The statements are taken last first, so
that d_r is complete before it is passed on.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from cfx.simulation.kernel.columns import Unsupported, literal
from cfx.simulation.kernel.graph import Assignment, power

_RULES: dict[str, tuple[str, ...]] = {
    "add": ("{g}", "{g}"),
    "sub": ("{g}", "(-{g})"),
    "rsub": ("(-{g})", "{g}"),
    "mul": ("({g} * {1})", "({g} * {0})"),
    "div": ("({g} / {1})", "(-{g} * {r} / {1})"),
    "neg": ("(-{g})",),
    "abs": ("({0} > real(0) ? {g} : {0} < real(0) ? -{g} : real(0))",),
    "sqrt": ("({g} / (real(2) * {r}))",),
    "rsqrt": ("(real(-0.5) * {g} * ({r} * {r} * {r}))",),
    "reciprocal": ("(-{g} * {r} * {r})",),
    "square": ("({g} * (real(2) * {0}))",),
    "exp": ("({g} * {r})",),
    "log": ("({g} / {0})",),
    "log1p": ("({g} / ({0} + real(1)))",),
    "expm1": ("({g} * ({r} + real(1)))",),
    "tanh": ("({g} * (real(1) - {r} * {r}))",),
    "sin": ("({g} * std::cos({0}))",),
    "cos": ("(-{g} * std::sin({0}))",),
    "atan": ("({g} / ({0} * {0} + real(1)))",),
    "_to_copy": ("",),
    "floor": ("",),
    "ceil": ("",),
    "sigmoid": ("({g} * ((real(1) - {r}) * {r}))",),
    "relu": ("({r} > real(0) ? {g} : real(0))",),
    "minimum": (
        "({0} < {1} ? {g} : {0} == {1} ? {g} * real(0.5) : real(0))",
        "({1} < {0} ? {g} : {0} == {1} ? {g} * real(0.5) : real(0))",
    ),
    "maximum": (
        "({0} > {1} ? {g} : {0} == {1} ? {g} * real(0.5) : real(0))",
        "({1} > {0} ? {g} : {0} == {1} ? {g} * real(0.5) : real(0))",
    ),
    "clamp_min": ("({0} >= {1} ? {g} : real(0))", "({0} < {1} ? {g} : real(0))"),
    "clamp_max": ("({0} <= {1} ? {g} : real(0))", "({0} > {1} ? {g} : real(0))"),
    "clamp": (
        "(({0} >= {1}) & ({0} <= {2}) ? {g} : real(0))",
        "(({0} < {1}) & ({1} < {2}) ? {g} : real(0))",
        "(({0} > {2}) | ({1} > {2}) ? {g} : real(0))",
    ),
    "pow": (
        "({1} == real(0) ? real(0) : {g} * ({1} * std::pow({0}, {1} - real(1))))",
        "(({0} == real(0)) & ({1} >= real(0)) ? real(0) : {g} * ({r} * std::log({0})))",
    ),
    "where": ("", "({0} ? {g} : real(0))", "({0} ? real(0) : {g})"),
    "nan_to_num": ("({0} - {0} == real(0) ? {g} : real(0))",),
}
"""What an operation adds to the derivative by each operand {0}, {1}, {2}.

{r} is its result and {g} the derivative by it. "" is a derivative of 0. Each rule is that of
PyTorch (`derivatives.yaml` there), also where a function has a kink: `clamp` passes the gradient on
at its bounds, equal operands of `minimum` and `maximum` share it.
"""


def adjoint(
    statements: Sequence[Assignment],
    inputs: Collection[str],
    gradients: Mapping[str, Sequence[str]],
) -> tuple[list[str], dict[str, str]]:
    """Returns C++ statements behind those of the function, and the derivatives by its inputs.

    Args:
        statements: of the function.
        inputs: by which it is differentiated.
        gradients: for the name of each value that the function returns, what is to be added up.

    Returns:
        Declarations in order, and an expression for each of the inputs.

    Raises:
        Unsupported: an operation has no rule here.
    """
    # Values that depend on an input; conditions have no derivative.
    active = set(inputs)
    for statement in statements:
        if not statement.is_condition and active.intersection(statement.operands):
            active.add(statement.name)
    summands = {name: list(added) for name, added in gradients.items()}
    declarations = []
    for statement in reversed(statements):
        if statement.name not in active or statement.name not in summands:
            continue
        derivative = f"d_{statement.name}"
        declarations.append(f"const real {derivative} = {' + '.join(summands[statement.name])};")
        for operand, rule in zip(statement.operands, _rules(statement), strict=False):
            if operand in active and rule:
                added = rule.format(*statement.operands, g=derivative, r=statement.name)
                summands.setdefault(operand, []).append(added)
    derivatives = {}
    for name in inputs:
        derivatives[name] = " + ".join(summands.get(name, ["real(0)"]))
    return declarations, derivatives


def _rules(statement: Assignment) -> tuple[str, ...]:
    """Returns what a statement adds to the derivative by each operand, as `_RULES` has it."""
    operation, _, exponent = statement.operation.partition(" ")
    if exponent:
        # d x^e / dx = e x^(e - 1), with the powers that PyTorch multiplies out.
        value = float(exponent)
        factor = power("{0}", value - 1.0, literal(value - 1.0))
        return (f"({{g}} * ({literal(value)} * {factor}))",)
    if operation not in _RULES:
        raise Unsupported(f"the derivative of {operation or statement.expression}")
    return _RULES[operation]
