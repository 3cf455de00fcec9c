"""Platoons of simulated drivers whose true parameters are known.

A platoon drives behind a leader in stop-and-go traffic; each follower is the leader of the next. Drivers differ from one
another, and each driver's parameters drift smoothly in time. What they truly were is kept in `Pair.truth`, so that
recovery can be measured.

Processes: the leader's wishes are a smooth Gaussian process around a cruising speed plus a renewal process of slow phases, felt
through a response with bounded acceleration and jerk. Parameters follow a critically damped second-order autoregression (the
discrete form of a Gaussian process with Matern-3/2 covariance: continuous, with a continuous slope).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.signal import lfilter

from cfx.component import Settings
from cfx.datasets.base import Dataset, DatasetSettings
from cfx.errors import DataError
from cfx.pairs import Dropped, Pair, PairSet

if TYPE_CHECKING:
    from cfx.models.base import DrivingModel
    from cfx.parameters import ParameterSpace

Floats = NDArray[np.float64]

HOLD_S = 0.5
"""Seconds for which a driver's parameters are held: the paper's window."""

_WARM_UP_S = 60.0  # drivers settle behind their leaders before the recording begins
_CRUISE_MPS = (9.0, 16.0)  # congested motorway
_CRAWL_MPS = (
    1.5,
    5.0,
)  # speed in the slow phase of a wave; above 0, where Krauss's gap would vanish
_GO_S, _SLOW_S = 25.0, 10.0  # mean lengths of the two phases
_SPEED_SD_MPS, _SPEED_SCALE_S = 0.8, 6.0  # the leader's own restlessness
_ACCELERATION_MPS2, _BRAKING_MPS2, _JERK_MPS3 = 1.8, 2.5, 1.5
_RESPONSE_PER_S = 0.5
_DRIFT_SCALE_S = 8.0  # over which a driver's parameters change
_LENGTH_M = (4.2, 5.2)


class SyntheticSettings(DatasetSettings):
    """What to simulate."""

    min_frames: int = Field(2, ge=2, description="shortest pair that is kept, frames")
    seed: int = Field(0, ge=0, description="same seed, same data")
    pairs: int = Field(8, ge=1, description="number of leader-follower pairs")
    frames: int = Field(600, ge=2, description="frames of each pair")
    dt: float = Field(0.1, gt=0, le=1, description="time step, s")
    platoon_size: int = Field(
        4, ge=1, description="followers in a platoon; each is the leader of the next"
    )
    model: Literal["krauss", "w99"] = Field(
        "krauss", description="the driving model that the drivers truly follow"
    )
    variation: float = Field(
        0.4, ge=0, le=1, description="how much true parameters drift in time; 0: constant"
    )
    heterogeneity: float = Field(
        0.6, ge=0, le=1, description="how much drivers differ; 0: all at the model's defaults"
    )
    noise_position_m: float = Field(
        0.0, ge=0, description="standard deviation of measured positions, m"
    )
    noise_speed_mps: float = Field(
        0.0, ge=0, description="standard deviation of measured speeds, m/s"
    )


class SyntheticDataset(Dataset):
    """Simulated platoons; needs no file.

    The true parameters stay within half of the way from the model's default to its nearer bound when `heterogeneity +
    variation` is 1, and never leave the bounds. They are held for half a second at a time; `Pair.truth[name][t]` is what
    held from frame t to t + 1. Without noise, simulating a pair from its first frame with its true parameters gives the
    recorded trajectory again.

    Measurement noise is white and belongs to the vehicle: as follower in one pair and leader in the next it reads the same.
    Speeds are cut off at 0, and accelerations are differences of measured speeds. A pair whose measured leader is behind its
    follower at any frame is dropped and counted.
    """

    schema: ClassVar[type[Settings]] = SyntheticSettings
    settings: SyntheticSettings

    def read(self) -> PairSet:
        s = self.settings
        rng = np.random.default_rng(s.seed)
        platoons = -(-s.pairs // s.platoon_size)
        traffic = _simulate(s, platoons, rng)
        measured = _measure(traffic, s, rng)
        pairs = [
            _pair(measured, s, k // s.platoon_size, k % s.platoon_size) for k in range(s.pairs)
        ]
        sound = [pair for pair in pairs if (pair.gap > 0).all()]
        lost = len(pairs) - len(sound)
        reason = "measurement noise puts the leader behind its follower"
        return PairSet(
            tuple(sound), f"synthetic (seed {s.seed})", (Dropped(reason, lost),) if lost else ()
        )


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
    import torch

    from cfx.models.base import Leader
    from cfx.simulation.rollout import simulate
    from cfx.simulation.trajectory import Start

    model = _model(s.model)
    hold = max(1, round(HOLD_S / s.dt))
    warm = hold * round(_WARM_UP_S / (hold * s.dt))
    frames = warm + s.frames
    windows = -(-frames // hold)
    unit = _true_parameters(model.space, (platoons, s.platoon_size), windows, hold * s.dt, s, rng)
    parameters = model.space.from_unit(torch.from_numpy(unit))
    length = torch.from_numpy(rng.uniform(*_LENGTH_M, (platoons, s.platoon_size + 1)))
    speed = torch.from_numpy(leader_speed(platoons, frames, s.dt, rng))
    position = torch.cat(
        [torch.zeros(platoons, 1, dtype=speed.dtype), (speed[:, 1:] * s.dt).cumsum(1)], 1
    )
    positions, speeds = [position], [speed]
    for k in range(s.platoon_size):
        ahead = Leader(
            positions[k],
            speeds[k],
            torch.from_numpy(differences(speeds[k].numpy(), s.dt)),
            length[:, k],
        )
        begin = positions[k][:, 0] - length[:, k] - 5.0 - 2.0 * speeds[k][:, 0]
        start = Start(begin, speeds[k][:, 0], torch.zeros(platoons, dtype=speed.dtype))
        # Never compiled: eager arithmetic gives the same bits wherever there is the same seed.
        drive = simulate(model, parameters[:, k], ahead, start, s.dt, window=hold, compile="never")
        if drive.collided.any():
            raise DataError(
                f"synthetic data: a driver of data.model={s.model} collides with seed {s.seed}; lower data.variation or"
                " data.heterogeneity, or take another data.seed"
            )
        positions.append(drive.position)
        speeds.append(drive.speed)
    whole = torch.stack(speeds, 1).numpy()
    held = np.repeat(parameters.numpy(), hold, axis=2)[:, :, warm:frames]
    return _Traffic(
        torch.stack(positions, 1).numpy()[..., warm:],
        whole[..., warm:],
        differences(whole, s.dt)[..., warm:],
        length.numpy(),
        held,
        model.space.names,
    )


def _model(name: str) -> DrivingModel:
    if name == "krauss":
        from cfx.models.krauss import Krauss

        return Krauss()
    from cfx.models.w99 import W99

    return W99()


def differences(speed: Floats, dt: float) -> Floats:
    """Returns the realised acceleration `(*batch, F)`, `(v(t) - v(t - dt)) / dt`, m/s2; 0 at the first frame."""
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
    own = rng.uniform(-1.0, 1.0, (*drivers, 1, len(space)))
    drift = np.tanh(
        0.7 * smooth_noise((*drivers, len(space)), windows, step / _DRIFT_SCALE_S, rng)
    ).swapaxes(-1, -2)
    unit: Floats = default + room * (s.heterogeneity * own + s.variation * drift)
    return unit


def smooth_noise(
    batch: tuple[int, ...], steps: int, step: float, rng: np.random.Generator
) -> Floats:
    """Returns a stationary smooth Gaussian process `(*batch, steps)` with mean 0 and variance 1.

    A critically damped second-order autoregression with pole phi = exp(-step); its variance for unit noise is
    (1 + phi^2) / (1 - phi^2)^3.

    Args:
        step: the time step in units of the correlation time.
    """
    phi = float(np.exp(-step))
    settle = int(np.ceil(12.0 / step))
    noise = rng.standard_normal((*batch, settle + steps))
    wide: Floats = lfilter([1.0], [1.0, -2.0 * phi, phi * phi], noise, axis=-1)[..., settle:]
    scaled: Floats = wide / np.sqrt((1.0 + phi * phi) / (1.0 - phi * phi) ** 3)
    return scaled


def leader_speed(platoons: int, frames: int, dt: float, rng: np.random.Generator) -> Floats:
    """Returns the speed of stop-and-go leaders, `(platoons, frames)`, m/s: never negative, acceleration and jerk bounded."""
    wanted = _wanted_speed(platoons, frames, dt, rng)
    speed = np.empty_like(wanted)
    v, a = wanted[:, 0].copy(), np.zeros(platoons)
    for k in range(frames):
        speed[:, k] = v
        aim = np.clip(_RESPONSE_PER_S * (wanted[:, k] - v), -_BRAKING_MPS2, _ACCELERATION_MPS2)
        a = a + np.clip(aim - a, -_JERK_MPS3 * dt, _JERK_MPS3 * dt)
        v = np.maximum(v + a * dt, 0.0)
    return speed


def _wanted_speed(platoons: int, frames: int, dt: float, rng: np.random.Generator) -> Floats:
    cruise = rng.uniform(*_CRUISE_MPS, (platoons, 1))
    restless = _SPEED_SD_MPS * smooth_noise((platoons,), frames, dt / _SPEED_SCALE_S, rng)
    waves = (
        int(np.ceil(3.0 * frames * dt / (_GO_S + _SLOW_S))) + 10
    )  # three times as many as fit on average
    phases = np.stack(
        [
            rng.gamma(4.0, _GO_S / 4.0, (platoons, waves)),
            rng.gamma(4.0, _SLOW_S / 4.0, (platoons, waves)),
        ],
        -1,
    )
    ends = phases.reshape(platoons, 2 * waves).cumsum(1) - rng.uniform(0.0, _GO_S, (platoons, 1))
    crawl = rng.uniform(*_CRAWL_MPS, (platoons, waves))
    time = np.arange(frames) * dt
    # Shifting each platoon's row beyond the one before makes one sorted array of all, so that one search serves.
    shift = np.arange(platoons)[:, None] * (ends.max() - ends.min() + frames * dt + 1.0)
    found = np.searchsorted((ends + shift).ravel(), (time + shift).ravel(), side="right").reshape(
        platoons, frames
    )
    phase = np.clip(found - 2 * waves * np.arange(platoons)[:, None], 0, 2 * waves - 1)
    slow = np.take_along_axis(crawl, phase // 2, axis=1)
    wanted: Floats = np.maximum(np.where(phase % 2 == 1, slow, cruise) + restless, 0.0)
    return wanted


def _measure(traffic: _Traffic, s: SyntheticSettings, rng: np.random.Generator) -> _Traffic:
    """Adds measurement noise; without any, returns the traffic as it is."""
    if s.noise_position_m == 0 and s.noise_speed_mps == 0:
        return traffic
    position = traffic.position + s.noise_position_m * rng.standard_normal(traffic.position.shape)
    speed, acceleration = traffic.speed, traffic.acceleration
    if s.noise_speed_mps > 0:
        # One more frame in front, so that the first acceleration is as noisy as the others.
        before = speed[..., :1] - acceleration[..., :1] * s.dt
        whole = np.concatenate([before, speed], -1)
        whole = np.maximum(whole + s.noise_speed_mps * rng.standard_normal(whole.shape), 0.0)
        speed, acceleration = whole[..., 1:], differences(whole, s.dt)[..., 1:]
    return _Traffic(position, speed, acceleration, traffic.length, traffic.truth, traffic.names)


def _pair(traffic: _Traffic, s: SyntheticSettings, platoon: int, place: int) -> Pair:
    first = platoon * (s.platoon_size + 1) + 1  # vehicles are numbered from 1, platoon by platoon
    leader, follower = str(first + place), str(first + place + 1)

    def signals(vehicle: int, who: str) -> dict[str, Any]:
        return {
            f"{who}_{name}": np.ascontiguousarray(getattr(traffic, name)[platoon, vehicle])
            for name in ("position", "speed", "acceleration")
        }

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
        truth={
            name: np.ascontiguousarray(traffic.truth[platoon, place, :, at])
            for at, name in enumerate(traffic.names)
        },
        truth_model=s.model,
    )
