"""Platoons of simulated drivers whose true parameters are known.

A platoon drives behind a leader in stop-and-go traffic; each follower is the leader of the next.
Drivers differ from one another, and each driver's parameters drift smoothly in time. What they
truly were is kept in `Pair.truth`, so that recovery can be measured.

Processes: the speed that the leader wants is a smooth Gaussian process around a cruising speed plus
a renewal process of slow phases; the leader responds to it with bounded acceleration and jerk.
Parameters follow a critically damped second-order autoregression (the discrete form of a Gaussian
process with Matern-3/2 covariance: continuous, with a continuous slope).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from cfx.core.component import Settings
from cfx.core.memory import require_memory
from cfx.data.base import Dataset, DatasetSettings
from cfx.data.pairs import Dropped, Pair, PairSet
from cfx.errors import DataError

if TYPE_CHECKING:
    from torch import Tensor

    from cfx.core.parameters import ParameterSpace
    from cfx.models.base import DrivingModel

Floats = NDArray[np.float64]

HOLD_S = 0.5
"""Seconds for which a driver's parameters stay the same: the paper's window."""

_WARM_UP_S = 60.0  # drivers settle behind their leaders before the recording begins
_FASTEST_MPS = 60.0  # at which leaders may cruise
_CRAWL_MPS = (1.5, 5.0)  # slow phase of a wave; above 0, where Krauss's gap would vanish
_GO_S, _SLOW_S = 25.0, 10.0  # mean lengths of the two phases
_SPEED_SD_MPS, _SPEED_SCALE_S = 0.8, 6.0  # the leader's own variation of speed
_ACCELERATION_MPS2, _BRAKING_MPS2, _JERK_MPS3 = 1.8, 2.5, 1.5
_RESPONSE_PER_S = 0.5
_DRIFT_SCALE_S = 8.0  # over which a driver's parameters change
LENGTH_M = (4.2, 5.2)
"""m: between which vehicles' lengths are."""
_BYTES = 200.0  # of a pair and frame: signals, and the true parameters over time


class SyntheticSettings(DatasetSettings):
    """Settings of synthetic pairs."""

    min_duration: float = Field(0.0, ge=0, description="s: shortest pair that is kept; 0: all")
    seed: int = Field(0, ge=0, description="same seed, same data")
    pairs: int = Field(8, ge=1, description="number of leader-follower pairs")
    frames: int = Field(600, ge=2, description="frames of each pair")
    dt: float = Field(0.1, ge=0.001, le=1, description="time step, s")
    platoon_size: int = Field(
        4, ge=1, description="followers in a platoon; each is the leader of the next"
    )
    model: Literal["krauss", "w99", "idm"] = Field(
        "krauss", description="the driving model that the drivers truly follow"
    )
    cruise_mps: tuple[float, float] = Field(
        (9.0, 16.0),
        description="m/s: between which speeds leaders cruise; the default is a congested motorway",
    )
    variation: float = Field(
        0.4, ge=0, le=1, description="how much true parameters drift in time; 0: constant"
    )
    heterogeneity: float = Field(
        0.6, ge=0, le=1, description="how much drivers differ; 0: all at the model's defaults"
    )
    noise_position_m: float = Field(
        0.0, ge=0, le=10, description="standard deviation of measured positions, m"
    )
    noise_speed_mps: float = Field(
        0.0, ge=0, le=10, description="standard deviation of measured speeds, m/s"
    )

    @field_validator("cruise_mps")
    @classmethod
    def _in_order(cls, cruise: tuple[float, float]) -> tuple[float, float]:
        if not 0 < cruise[0] <= cruise[1] <= _FASTEST_MPS:
            raise ValueError(
                f"give a lower and a higher speed above 0 and up to {_FASTEST_MPS:g} m/s"
            )
        return cruise


class SyntheticDataset(Dataset):
    """Simulated platoons; needs no file.

    The true parameters stay within half of the way from the model's default to its nearer bound
    when `heterogeneity + variation` is 1, and never leave the bounds. They stay the same for half a
    second at a time; `Pair.truth[name][t]` is in force from frame t to t + 1. Without noise,
    simulating a pair from its first frame with its true parameters gives the recorded trajectory
    again.

    Measurement noise is white and belongs to the vehicle: as follower in one pair and leader in the
    next it reads the same. Speeds are cut off at 0, and accelerations are differences of measured
    speeds. A pair whose measured leader is behind its follower at any frame is dropped and counted.
    """

    schema: ClassVar[type[Settings]] = SyntheticSettings
    settings: SyntheticSettings
    trial: ClassVar[Mapping[str, Any]] = {"pairs": 4, "platoon_size": 2, "frames": 150}

    def read(self) -> PairSet:
        s = self.settings
        frames = s.frames + round(_WARM_UP_S / s.dt)
        require_memory(_BYTES * s.pairs * frames, f"data.pairs={s.pairs} of {s.frames} frames")
        rng = np.random.default_rng(s.seed)
        platoons = math.ceil(s.pairs / s.platoon_size)
        traffic = _simulate(s, platoons, rng)
        measured = _measure(traffic, s, rng)
        pairs = []
        for number in range(s.pairs):
            platoon, place = divmod(number, s.platoon_size)
            pair = _pair(measured, s, platoon, place)
            if (pair.gap > 0).all():
                pairs.append(pair)
        dropped: tuple[Dropped, ...] = ()
        if len(pairs) < s.pairs:
            reason = "measurement noise puts the leader behind its follower"
            dropped = (Dropped(reason, s.pairs - len(pairs)),)
        return PairSet(tuple(pairs), f"synthetic (seed {s.seed})", dropped)


@dataclass(frozen=True)
class _Traffic:
    """S platoons of V = platoon_size + 1 vehicles, the first being the leader of all; F frames.

    Attributes:
        position, speed, acceleration: `(S, V, F)`, SI units.
        length: `(S, V)`, m.
        truth: `(S, V - 1, F, n)`, the followers' true parameters.
        names: the n parameters.
    """

    position: Floats
    speed: Floats
    acceleration: Floats
    length: Floats
    truth: Floats
    names: tuple[str, ...]


def _simulate(s: SyntheticSettings, platoons: int, rng: np.random.Generator) -> _Traffic:
    """Returns the platoons as they truly drive, after the warm-up."""
    import torch

    model = _model(s.model)
    hold = max(1, round(HOLD_S / s.dt))
    warm = hold * round(_WARM_UP_S / (hold * s.dt))
    frames = warm + s.frames
    windows = math.ceil(frames / hold)
    unit = _true_parameters(model.space, (platoons, s.platoon_size), windows, hold * s.dt, s, rng)
    parameters = model.space.from_unit(torch.from_numpy(unit))
    length = torch.from_numpy(rng.uniform(*LENGTH_M, (platoons, s.platoon_size + 1)))
    speed = torch.from_numpy(leader_speed(platoons, frames, s.dt, rng, s.cruise_mps))
    position, speed, collided = simulate_platoons(model, parameters, speed, length, hold, s.dt)
    if collided:
        raise DataError(
            f"synthetic data: a driver of data.model={s.model} collides with seed {s.seed};"
            " lower data.variation or data.heterogeneity, or take another data.seed"
        )
    all_speeds = speed.numpy()
    return _Traffic(
        position=position.numpy()[..., warm:],
        speed=all_speeds[..., warm:],
        acceleration=differences(all_speeds, s.dt)[..., warm:],
        length=length.numpy(),
        truth=np.repeat(parameters.numpy(), hold, axis=2)[:, :, warm:frames],
        names=model.space.names,
    )


def simulate_platoons(
    model: DrivingModel,
    parameters: Tensor,
    leader_speed: Tensor,
    length: Tensor,
    hold: int,
    dt: float,
) -> tuple[Tensor, Tensor, bool]:
    """Simulates S platoons of V - 1 followers; each vehicle is the leader of the next.

    Args:
        model: by which they drive.
        parameters: `(S, V - 1, W, n)`; each of the W windows is `hold` frames.
        leader_speed: of the first vehicle, `(S, F)`, m/s.
        length: of the vehicles, `(S, V)`, m.
        hold: frames for which parameters hold.
        dt: time step, s.

    Returns:
        Positions (m) and speeds (m/s) of all vehicles, `(S, V, F)`, and whether any collided.
    """
    import torch

    from cfx.models.base import Leader
    from cfx.simulation.rollout import simulate_follower
    from cfx.simulation.trajectory import Start

    moved = (leader_speed[:, 1:] * dt).cumsum(1)
    positions = [torch.cat([torch.zeros_like(leader_speed[:, :1]), moved], 1)]
    speeds, collided = [leader_speed], False
    for place in range(length.shape[1] - 1):
        position, speed = positions[-1], speeds[-1]
        acceleration = torch.from_numpy(differences(speed.numpy(), dt))
        leader = Leader(position, speed, acceleration, length[:, place])
        begin = position[:, 0] - length[:, place] - 5.0 - 2.0 * speed[:, 0]
        start = Start(begin, speed[:, 0], torch.zeros_like(begin))
        # Never compiled: eager arithmetic gives the same bits wherever there is the same seed.
        trajectory = simulate_follower(
            model, parameters[:, place], leader, start, dt, window=hold, compile="never"
        )
        collided = collided or bool(trajectory.collided.any())
        positions.append(trajectory.position)
        speeds.append(trajectory.speed)
    return torch.stack(positions, 1), torch.stack(speeds, 1), collided


def _model(name: str) -> DrivingModel:
    if name == "krauss":
        from cfx.models.krauss import Krauss

        return Krauss()
    if name == "idm":
        from cfx.models.idm import IDM

        return IDM()
    from cfx.models.w99 import W99

    return W99()


def differences(speed: Floats, dt: float) -> Floats:
    """Returns the realised acceleration `(v(t) - v(t - dt)) / dt`, m/s2; 0 at the first frame.

    Shapes: `(*batch, F)` -> `(*batch, F)`.
    """
    acceleration = np.zeros_like(speed)
    acceleration[..., 1:] = (speed[..., 1:] - speed[..., :-1]) / dt
    return acceleration


def _true_parameters(
    space: ParameterSpace,
    drivers: tuple[int, ...],
    windows: int,
    step: float,
    s: SyntheticSettings,
    rng: np.random.Generator,
) -> Floats:
    """Returns true parameters in unit space, `(*drivers, windows, n)`."""
    default = np.array([(p.default - p.low) / (p.high - p.low) for p in space.tuned])
    room = 0.5 * np.minimum(default, 1.0 - default)
    driver = rng.uniform(-1.0, 1.0, (*drivers, 1, len(space)))
    noise = smooth_noise((*drivers, len(space)), windows, step / _DRIFT_SCALE_S, rng)
    drift = np.tanh(0.7 * noise).swapaxes(-1, -2)
    unit: Floats = default + room * (s.heterogeneity * driver + s.variation * drift)
    return unit


def smooth_noise(
    batch: tuple[int, ...], steps: int, step: float, rng: np.random.Generator
) -> Floats:
    """Returns a stationary smooth Gaussian process `(*batch, steps)` with mean 0 and variance 1.

    A critically damped second-order autoregression with pole phi = exp(-step); its variance for
    unit noise is (1 + phi^2) / (1 - phi^2)^3.

    Args:
        step: the time step in units of the correlation time.
    """
    phi = float(np.exp(-step))
    settle = int(np.ceil(12.0 / step))
    wide = rng.standard_normal((*batch, settle + steps))
    # To the last bit what `scipy.signal.lfilter` gives, whose import takes longer than all the rest
    # of the synthetic recording.
    before, two_before = np.zeros(batch), np.zeros(batch)
    for k in range(settle + steps):
        wide[..., k] += before
        before, two_before = two_before + 2.0 * phi * wide[..., k], -(phi * phi) * wide[..., k]
    wide = wide[..., settle:]
    scaled: Floats = wide / np.sqrt((1.0 + phi * phi) / (1.0 - phi * phi) ** 3)
    return scaled


def leader_speed(
    platoons: int,
    frames: int,
    dt: float,
    rng: np.random.Generator,
    cruise_mps: tuple[float, float] = (9.0, 16.0),
) -> Floats:
    """Returns the speed of stop-and-go leaders, `(platoons, frames)`, m/s.

    It is never negative, and its acceleration and jerk are bounded.
    """
    desired = _desired_speed(platoons, frames, dt, rng, cruise_mps)
    speed = np.empty_like(desired)
    v, a = desired[:, 0].copy(), np.zeros(platoons)
    for k in range(frames):
        speed[:, k] = v
        aim = np.clip(_RESPONSE_PER_S * (desired[:, k] - v), -_BRAKING_MPS2, _ACCELERATION_MPS2)
        a = a + np.clip(aim - a, -_JERK_MPS3 * dt, _JERK_MPS3 * dt)
        v = np.maximum(v + a * dt, 0.0)
    return speed


def _desired_speed(
    platoons: int,
    frames: int,
    dt: float,
    rng: np.random.Generator,
    cruise_mps: tuple[float, float],
) -> Floats:
    """Returns the speed that the leaders want, `(platoons, frames)`, m/s."""
    cruise = rng.uniform(*cruise_mps, (platoons, 1))
    variation = _SPEED_SD_MPS * smooth_noise((platoons,), frames, dt / _SPEED_SCALE_S, rng)
    # Three times as many waves as fit on average.
    waves = int(np.ceil(3.0 * frames * dt / (_GO_S + _SLOW_S))) + 10
    go = rng.gamma(4.0, _GO_S / 4.0, (platoons, waves))
    slow = rng.gamma(4.0, _SLOW_S / 4.0, (platoons, waves))
    phases = np.stack([go, slow], -1)
    ends = phases.reshape(platoons, 2 * waves).cumsum(1) - rng.uniform(0.0, _GO_S, (platoons, 1))
    crawl = rng.uniform(*_CRAWL_MPS, (platoons, waves))
    time = np.arange(frames) * dt
    # Shifting each platoon's row beyond the one before makes one sorted array of all, so that one
    # search serves.
    platoon = np.arange(platoons)[:, None]
    shift = platoon * (ends.max() - ends.min() + frames * dt + 1.0)
    number = np.searchsorted((ends + shift).ravel(), (time + shift).ravel(), side="right")
    phase = number.reshape(platoons, frames) - 2 * waves * platoon
    phase = np.clip(phase, 0, 2 * waves - 1)
    crawl_speed = np.take_along_axis(crawl, phase // 2, axis=1)
    speed = np.where(phase % 2 == 1, crawl_speed, cruise)
    desired: Floats = np.maximum(speed + variation, 0.0)
    return desired


def _measure(traffic: _Traffic, s: SyntheticSettings, rng: np.random.Generator) -> _Traffic:
    """Adds measurement noise; without any, returns the traffic as it is."""
    if s.noise_position_m == 0 and s.noise_speed_mps == 0:
        return traffic
    position = traffic.position + s.noise_position_m * rng.standard_normal(traffic.position.shape)
    speed, acceleration = traffic.speed, traffic.acceleration
    if s.noise_speed_mps > 0:
        # One more frame in front, so that the first acceleration is as noisy as the others.
        before = speed[..., :1] - acceleration[..., :1] * s.dt
        longer = np.concatenate([before, speed], -1)
        longer = longer + s.noise_speed_mps * rng.standard_normal(longer.shape)
        longer = np.maximum(longer, 0.0)
        speed = longer[..., 1:]
        acceleration = differences(longer, s.dt)[..., 1:]
    return _Traffic(position, speed, acceleration, traffic.length, traffic.truth, traffic.names)


def _pair(traffic: _Traffic, s: SyntheticSettings, platoon: int, place: int) -> Pair:
    """Returns the pair of the vehicle at a place of a platoon and the one behind it."""
    first = platoon * (s.platoon_size + 1) + 1  # vehicles are numbered from 1, platoon by platoon
    leader, follower = str(first + place), str(first + place + 1)

    def signals(vehicle: int, who: str) -> dict[str, Any]:
        columns = {}
        for name in ("position", "speed", "acceleration"):
            values = getattr(traffic, name)[platoon, vehicle]
            columns[f"{who}_{name}"] = np.ascontiguousarray(values)
        return columns

    truth = {}
    for at, name in enumerate(traffic.names):
        truth[name] = np.ascontiguousarray(traffic.truth[platoon, place, :, at])
    return Pair(
        pair_id=f"synthetic-{follower}-{leader}",
        recording="synthetic",
        leader_id=leader,
        follower_id=follower,
        first_frame=0,
        dt=s.dt,
        leader_length=float(traffic.length[platoon, place]),
        **signals(place, "leader"),
        **signals(place + 1, "follower"),
        truth=truth,
        truth_model=s.model,
    )
