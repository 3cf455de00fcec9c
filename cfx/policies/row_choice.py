"""Networks that answer for rows of a table: what live drivers ask a policy, of many at once.

It is what `Agent.act` computes, with the state of drivers in columns of a table. What is no product
of matrices and no recurrent cell is compiled code (`cfx.simulation.kernel.rows`), recorded from the
agent's own functions: those are some hundred operations of a few numbers each.

Shapes: C rows of a table, D drivers, N networks, L frames of a token, g signals, n tuned
parameters, c features of conditioning, s width of the networks' state, q numbers that a stochastic
head keeps, k random numbers of a window, f signals of a situation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from cfx.core.component import folder_hash
from cfx.core.memory import keep_freed_memory
from cfx.data.signals import OBSERVED
from cfx.policies.agent import Agent, AgentState
from cfx.policies.context import DriverContext
from cfx.policies.core import ANY_DRIVER, driver_places
from cfx.policies.history import History
from cfx.policies.valid_range import RANGE_SIGNALS, ValidRange
from cfx.simulation.kernel.rows import RowFunction, Rows, row_function
from cfx.simulation.kernel.run import component_code


class DriverRows(NamedTuple):
    """Columns of a table with a row for each driver; double precision but for `state`.

    Attributes:
        history: `(C, g, L)`, the signals `OBSERVED`, SI units.
        network: `(C,)` int64, which of the agent's networks drives.
        base: `(C, n)` in unit space, of which answers are offsets; `(C, 0)` where the head needs
            none.
        conditioning: `(C, c)`, what networks read of each driver in every window.
        state: `(C, s)`, of the networks, in their precision.
        latent: `(C, q)`, what a stochastic head keeps of its random numbers.
        parameters: `(C, n)`, SI units, of the last window.
        score: `(C,)`, how far outside what was learned each was then.
        beyond: `(C, 2 f)`, 1 for signals that alone were unusual then, too low and then too high.
    """

    history: Tensor
    network: Tensor
    base: Tensor
    conditioning: Tensor
    state: Tensor
    latent: Tensor
    parameters: Tensor
    score: Tensor
    beyond: Tensor


class RowChoice:
    """Lets an agent's networks answer for rows of a table.

    Life cycle: `begin` for drivers who begin; then `observe` or `act` once per window.

    Args:
        agent: whose networks answer.
    """

    def __init__(self, agent: Agent) -> None:
        # What networks compute lies in fresh memory; to have it mapped anew takes longer than to
        # fill it.
        keep_freed_memory()
        self._agent = agent
        self._facts = _facts_of(agent)
        self._encode = _encoder(agent)
        self._appliers: dict[bool, RowFunction] = {}

    def begin(self, drivers: DriverRows, rows: Tensor, context: DriverContext) -> None:
        """Puts the state of drivers before their first window into their rows.

        Args:
            drivers: the table; which network drives stands there.
            rows: `(D,)` int64.
            context: what is known of these drivers.
        """
        begun = self._agent.begin(drivers.network[rows], context)
        if begun.base is not None:
            drivers.base[rows] = begun.base
        drivers.conditioning[rows] = begun.conditioning.to(drivers.conditioning)
        drivers.state[rows] = begun.state[begun.network, begun.place]
        drivers.latent[rows] = begun.latent

    @torch.no_grad()
    def act(self, drivers: DriverRows, rows: Tensor, noise: Tensor | None = None) -> None:
        """Chooses the parameters of the next window of drivers, as `Agent.act` does.

        Args:
            drivers: the table; parameters, states and scores are written there.
            rows: `(D,)` int64, each once.
            noise: standard normal, `(D, k)`; None: nothing is drawn.

        Raises:
            PluginError: the networks answer numbers that are not finite.
        """
        places = self._places(drivers, rows)
        features, state = self._asked(drivers, rows, places)
        answers, after = self._agent.core.act_once(features, state)
        drivers.state[rows] = after[places]
        answer = answers[places].double()
        self._agent.require_finite(answer)
        network, latent = drivers.network[rows], Rows(drivers.latent, rows)
        inputs = [Rows(answer), Rows(drivers.base, rows), _flat(drivers.history, rows), latent]
        inputs += [Rows(values, network) for values in self._facts.values()]
        if noise is not None:
            inputs.append(Rows(noise))
        outputs = [
            Rows(drivers.parameters, rows),
            latent,
            Rows(drivers.score, rows),
            Rows(drivers.beyond, rows),
        ]
        self._applier(draws=noise is not None)(len(rows), inputs, outputs)

    @torch.no_grad()
    def observe(self, drivers: DriverRows, rows: Tensor) -> None:
        """Lets networks see a window of drivers without acting, as `Agent.observe` does."""
        places = self._places(drivers, rows)
        features, state = self._asked(drivers, rows, places)
        present = torch.ones(features.shape[:2], dtype=torch.bool)
        drivers.state[rows] = self._agent.core.observe(features, state, present)[places]

    def _places(self, drivers: DriverRows, rows: Tensor) -> tuple[Tensor | int, Tensor | slice]:
        """Returns where drivers stand among those of their networks, as an index of `(N, B)`."""
        if len(self._agent.names) == 1:
            return 0, slice(None)
        network = drivers.network[rows]
        return network, driver_places(network)

    def _asked(
        self, drivers: DriverRows, rows: Tensor, places: tuple[Tensor | int, Tensor | slice]
    ) -> tuple[Tensor, Tensor]:
        """Returns what networks read, `(N, B, f + c)`, and their state, `(N, B, s)`."""
        mean = self._agent.core.scaler.mean
        read = torch.empty((len(rows), mean.shape[-1]), dtype=torch.float64)
        inputs = [_flat(drivers.history, rows), Rows(drivers.conditioning, rows)]
        self._encode(len(rows), inputs, [Rows(read)])
        features, state = read.to(mean.dtype), drivers.state[rows]
        number, place = places
        if not isinstance(place, Tensor):
            return features[None], state[None]
        shape = (len(mean), int(place.max()) + 1)
        grid = features.new_zeros((*shape, features.shape[-1]))
        states = state.new_zeros((*shape, state.shape[-1]))
        grid[number, place], states[number, place] = features, state
        return grid, states

    def _applier(self, *, draws: bool) -> RowFunction:
        """Returns what makes parameters of answers, as a function of rows.

        It takes answers, the base, histories, what is kept of random numbers, what the network of
        each driver has (`_facts_of`), and random numbers if it draws some. It gives parameters,
        what is kept of random numbers, and scores.
        """
        if draws in self._appliers:
            return self._appliers[draws]
        agent, names = self._agent, tuple(self._facts)
        space, head, length = agent.space, agent.core.head, agent.windows.length

        def apply(*values: Tensor) -> tuple[Tensor, ...]:
            answer, base, frames, latent, *further = values
            facts = dict(zip(names, further, strict=False))
            state = AgentState(
                network=answer[:, 0],
                place=answer[:, 0],
                state=answer,
                base=base if head.needs_base else None,
                conditioning=base,
                score=answer[:, 0] * 0.0,
                beyond=answer[:, :0],
                latent=latent,
            )
            noise = further[-1] if draws else None
            alone = _with_facts(agent, facts)
            chosen, after = alone.apply(answer, _history(frames, length), state, noise)
            beyond = after.beyond.to(answer.dtype)
            return chosen, after.latent, after.score[:, None], beyond

        widths = [head.answers, len(space) if head.needs_base else 0, len(OBSERVED) * length]
        widths.append(head.latent_width)
        widths += [values.shape[-1] for values in self._facts.values()]
        if draws:
            widths.append(head.noise_width)
        key = _code_of(agent, type(head))
        if key is not None:
            key += [names, draws]
        self._appliers[draws] = row_function(apply, widths, key)
        return self._appliers[draws]


def _encoder(agent: Agent) -> RowFunction:
    """Returns what networks read as a function of rows: of histories and of conditioning."""
    core, length = agent.core, agent.windows.length

    def encode(frames: Tensor, conditioning: Tensor) -> tuple[Tensor]:
        return (torch.cat([core.encode(_history(frames, length)), conditioning], -1),)

    conditioning = core.head.width + len(core.driver_features)
    key = _code_of(agent, *(type(policy_input) for policy_input in core.inputs))
    return row_function(encode, [len(OBSERVED) * length, conditioning], key)


def _code_of(agent: Agent, *components: type) -> list[object] | None:
    """Returns what functions of an agent depend on, as JSON knows it; None as for `step_key`."""
    described: list[object] = [folder_hash(__file__), agent.core.summary]
    described += [agent.windows.length, agent.windows.stride, agent.dt]
    described += [repr(parameter) for parameter in agent.space]
    for component in components:
        code = component_code(component)
        if code is None:
            return None
        described.append(code)
    return described


def _facts_of(agent: Agent) -> dict[str, Tensor]:
    """Returns what each network has beside its weights, by name, `(N, width)`."""
    facts: dict[str, Tensor] = {}
    if agent.valid_range is not None:
        facts |= agent.valid_range._asdict()
    for name in ("pooled", "dispersion"):
        values = getattr(agent, name)
        if values is not None:
            facts[name] = values
    return {name: values.double().reshape(len(values), -1) for name, values in facts.items()}


def _with_facts(agent: Agent, facts: Mapping[str, Tensor]) -> Agent:
    """Returns an agent of one network whose facts are those of D drivers, `(D, width)` each."""
    valid_range = None
    if agent.valid_range is not None:
        signals = len(RANGE_SIGNALS)
        valid_range = ValidRange(
            facts["mean"],
            facts["precision"].view(-1, signals, signals),
            facts["distance"][:, 0],
            facts["low"],
            facts["high"],
        )
    dispersion = facts.get("dispersion")
    if dispersion is not None:
        dispersion = dispersion[:, 0]
    return replace(
        agent,
        names=(ANY_DRIVER,),
        valid_range=valid_range,
        pooled=facts.get("pooled"),
        dispersion=dispersion,
    )


def _history(frames: Tensor, length: int) -> History:
    """Returns the history that rows `(D, g L)` hold."""
    return dict(zip(OBSERVED, frames.view(-1, len(OBSERVED), length).unbind(1), strict=True))


def _flat(history: Tensor, rows: Tensor) -> Rows:
    return Rows(history.view(len(history), -1), rows)
