"""The adjoint of recorded statements, one by one.

Each rule is that of PyTorch, also where a function has a kink: `clamp` passes the gradient on at
its bounds, equal operands of `minimum` and `maximum` share it.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from cfx.simulation.kernel.columns import Unsupported, literal
from cfx.simulation.kernel.graph import Statement, power

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
"""What an operation of result {r} adds to the derivative by each operand, {g} being its own."""


def adjoint(
    statements: Sequence[Statement], wanted: Collection[str], gradients: Mapping[str, list[str]]
) -> tuple[list[str], dict[str, str]]:
    """Returns C++ statements behind those of the function, and the derivatives by its inputs.

    Args:
        statements: of the function.
        wanted: the inputs by which it is differentiated.
        gradients: of a number by each result that the function returns; what to add up.

    Returns:
        Declarations in order, and an expression for each wanted input.

    Raises:
        Unsupported: an operation has no rule here.
    """
    active = set(wanted)
    for statement in statements:
        if not statement.is_condition and active.intersection(statement.operands):
            active.add(statement.name)
    parts = {name: list(added) for name, added in gradients.items()}
    lines = []
    for statement in reversed(statements):
        if statement.name not in active or statement.name not in parts:
            continue
        own = f"d_{statement.name}"
        lines.append(f"const real {own} = {' + '.join(parts[statement.name])};")
        for operand, rule in zip(statement.operands, _rules(statement), strict=False):
            if operand in active and rule:
                added = rule.format(*statement.operands, g=own, r=statement.name)
                parts.setdefault(operand, []).append(added)
    return lines, {name: " + ".join(parts.get(name, ["real(0)"])) for name in wanted}


def _rules(statement: Statement) -> tuple[str, ...]:
    operation, _, exponent = statement.operation.partition(" ")
    if exponent:
        value = float(exponent)
        factor = power("{0}", value - 1.0, literal(value - 1.0))
        return (f"({{g}} * ({literal(value)} * {factor}))",)
    if operation not in _RULES:
        raise Unsupported(f"the derivative of {operation or statement.expression}")
    return _RULES[operation]
