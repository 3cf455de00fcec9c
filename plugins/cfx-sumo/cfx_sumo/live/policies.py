"""Where the policy of a live driver comes from: a job, or constant parameters."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from cfx.errors import DataError, ParameterError
from cfx.plugin import (
    ANY_DRIVER,
    Agent,
    AgentCore,
    ConstantNetwork,
    DirectHead,
    DrivingModel,
    FixedPolicy,
    Scaler,
    WindowSettings,
    folder_of,
    job_folder,
    load_agent,
)


def load_policy(run: str | Path) -> Agent:
    """Reads the policy of a run.

    Raises:
        DataError: there is none, or the installed driving model has other parameters than it was
            trained for.
    """
    folder = folder_of(run)
    if not (folder / "policy.json").is_file():
        folder /= "policy"
    policy = load_agent(folder)
    written = job_folder.parse_json((folder / "policy.json").read_text(encoding="utf-8"))
    trained = written.get("parameters", [])
    if tuple(trained) != policy.space.names:
        raise DataError(
            f"the policy of {run} was trained for a model with the parameters {', '.join(trained)},"
            f" but model={policy.model_node['name']} here has {', '.join(policy.space.names)};"
            " train it again"
        )
    return policy


def constant_policy(model: DrivingModel, parameters: Mapping[str, float], dt: float) -> Agent:
    """Returns a policy that answers the same parameters always.

    Args:
        model: the driving model.
        parameters: name -> value, SI units; the others at their defaults.
        dt: time step of the model, s.

    Raises:
        ParameterError: the model has no such parameter.
    """
    space = model.space
    values = space.defaults()
    for name, value in parameters.items():
        if name not in space.names:
            raise ParameterError(
                f"'{name}' is no tuned parameter of this model; it has {', '.join(space.names)}"
            )
        values[space.names.index(name)] = value
    unit = space.to_unit(values)[None]
    scaler = Scaler(unit.new_zeros((1, 1)), unit.new_ones((1, 1)))
    return Agent(
        core=AgentCore(FixedPolicy(), ConstantNetwork(unit), scaler, DirectHead(space)),
        model_node={"name": type(model).__name__},
        policy_node={"name": "fixed"},
        windows=WindowSettings(),
        dt=dt,
        names=(ANY_DRIVER,),
        pooled=values[None],
    )


def check_model(model: DrivingModel, name: str, source: str) -> None:
    """Checks that a model can drive live.

    Args:
        model: the driving model.
        name: its name.
        source: where the policy comes from, for messages.

    Raises:
        DataError: it has equations in SUMO only, or may brake harder than a vehicle can.
    """
    if model.needs_simulator:
        raise DataError(
            f"{source} chooses parameters of model={name}, which SUMO alone drives: they cannot be"
            " changed on the way; a live driver needs a model that cfx has, such as krauss or w99"
        )
    if not model.brakes_within_bounds:
        raise DataError(
            f"{source}: its driving model has neither limits nor a brake cap, so it may brake"
            " harder than a vehicle can; train it with model.limits as they are by default"
            " (or model.variant=sumo) to drive live"
        )
