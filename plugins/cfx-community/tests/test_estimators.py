"""Classical estimators: against a library's Kalman filter, and on drivers whose parameters are known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from filterpy.kalman import KalmanFilter
from torch import Tensor

from cfx.calibration.cache import Cache
from cfx.calibration.calibrator import Calibrator
from cfx.calibration.gradient_search import GradientSearch
from cfx.calibration.shards import Solver
from cfx.data.pairs import PairBatch, PairSet
from cfx.data.signals import RECORDED
from cfx.errors import ConfigError
from cfx.evaluation.closed_loop import Followers, simulate_closed_loop
from cfx.evaluation.forecasts import Origins
from cfx.models.base import DrivingModel
from cfx.models.idm import IDM
from cfx.models.krauss import Krauss
from cfx.policies import checkpoint
from cfx.policies.agent import Agent
from cfx.policies.core import AgentCore
from cfx.policies.features import Scaler, token_width
from cfx.policies.heads import head_class
from cfx.policies.heads.base import DirectHead
from cfx.simulation.rollout import MemoryStepper
from cfx.simulation.windows import WindowSettings
from cfx_community.policies.estimator import EstimatorPolicy
from cfx_community.policies.particle_filter import ParticleFilterPolicy, reweighted
from cfx_community.policies.recalibrate import RecalibratePolicy
from cfx_community.policies.ukf import UkfPolicy, unscented_update
from cfx_contracts import check_contract
from tests.drives import simulate_from_origins, wavy_pairs

WINDOWS = WindowSettings()
ESTIMATORS = {
    "ukf": UkfPolicy(spread=1.0, drift=0.0, noise=0.05),
    "particle_filter": ParticleFilterPolicy(spread=1.0, drift=0.02, noise=0.2, particles=200),
    "recalibrate": RecalibratePolicy(prior=0.0),
}


@pytest.mark.parametrize("name", ESTIMATORS)
def test_contract_of_other_settings(name: str) -> None:
    check_contract(ESTIMATORS[name])


def agent_of(policy: EstimatorPolicy, model: DrivingModel, prior: Tensor) -> Agent:
    """Returns an agent with one network for each row of the prior, `(N, n)`, SI units."""
    policy = policy.for_model(model, 0.1, WINDOWS)
    features = token_width(policy.inputs, policy.summary, WINDOWS.length)
    unit = model.space.to_unit(prior)
    network = policy.build(features, unit[0], unit, torch.Generator().manual_seed(0))
    scaler = Scaler(unit.new_zeros((len(unit), features)), unit.new_ones((len(unit), features)))
    return Agent(
        AgentCore(policy, network.double().eval(), scaler, DirectHead(model.space)),
        {"name": "krauss"},
        {"name": "ukf"},
        WINDOWS,
        0.1,
        tuple(f"p{i}" for i in range(len(prior))),
    )


def krauss_drivers(frames: int = 300) -> tuple[PairBatch, PairSet, Tensor]:
    """Drivers of Krauss with time lags from 0.8 to 2.2 s, and their parameters."""
    true = torch.tensor([[0.8, 0.15], [1.5, 0.15], [2.2, 0.15]], dtype=torch.float64)
    pairs = wavy_pairs(Krauss(), true, frames=frames)
    return PairBatch.of(pairs), pairs, true


def linear_case(steps: int = 25, n: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Measured values of a random linear function of three parameters in each step."""
    draw = np.random.default_rng(0)
    rows = draw.normal(size=(steps, n))
    truth = np.array([0.5, -1.0, 2.0])
    return rows, rows @ truth + draw.normal(scale=0.3, size=steps)


def library_filter(rows: np.ndarray, values: np.ndarray, drift: float) -> KalmanFilter:
    """filterpy's Kalman filter of constant parameters with drift, after all measurements."""
    n = rows.shape[1]
    kalman = KalmanFilter(dim_x=n, dim_z=1)
    kalman.x = np.zeros(n)
    kalman.P, kalman.Q, kalman.R = np.eye(n), drift**2 * np.eye(n), np.array([[0.3**2]])
    for row, value in zip(rows, values, strict=True):
        kalman.predict()
        kalman.update(np.array([value]), H=row[None])
    return kalman


def test_the_ukf_is_the_kalman_filter_where_all_is_linear() -> None:
    rows, values = linear_case()
    expected = library_filter(rows, values, drift=0.05)
    mean = torch.zeros((2, 3), dtype=torch.float64)
    covariance = torch.eye(3, dtype=torch.float64).expand(2, 3, 3)
    for row, value in zip(torch.as_tensor(rows), values.tolist(), strict=True):
        covariance = covariance + 0.05**2 * torch.eye(3, dtype=torch.float64)
        mean, covariance = unscented_update(
            mean, covariance, lambda points, row=row: points @ row, mean.new_full((2,), value), 0.09
        )
    for driver in range(2):
        np.testing.assert_allclose(mean[driver], expected.x, atol=1e-6)
        np.testing.assert_allclose(covariance[driver], expected.P, atol=1e-6)


def test_the_particle_filter_approaches_the_kalman_filter_where_all_is_linear() -> None:
    rows, values = linear_case()
    expected = library_filter(rows, values, drift=0.05)
    draw = torch.Generator().manual_seed(0)
    particles = torch.randn((1, 10_000, 3), generator=draw, dtype=torch.float64)
    weights = torch.zeros((1, 10_000), dtype=torch.float64)
    for row, value in zip(torch.as_tensor(rows), values.tolist(), strict=True):
        noise = torch.randn(particles.shape, generator=draw, dtype=torch.float64)
        particles = particles + 0.05 * noise
        likelihood = -0.5 * ((particles @ row - value) / 0.3).square()
        uniform = torch.rand(1, generator=draw, dtype=torch.float64)
        particles, weights = reweighted(particles, weights, likelihood, uniform)
    share = weights.softmax(-1)[..., None]
    mean = (share * particles).sum(-2)
    spread = (share * (particles - mean[:, None]).square()).sum(-2).sqrt()
    deviation = np.sqrt(np.diag(expected.P))
    np.testing.assert_allclose(mean[0], expected.x, atol=0.1 * deviation.max())
    np.testing.assert_allclose(spread[0], deviation, rtol=0.1)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_estimates_converge_to_the_true_parameters(name: str) -> None:
    """From the same prior, each driver's time lag is found; with the pooled one it would be off."""
    batch, _, true = krauss_drivers()
    prior = torch.tensor([[1.5, 0.15]], dtype=torch.float64)
    agent = agent_of(ESTIMATORS[name], Krauss(), prior)
    loop = simulate_closed_loop(
        MemoryStepper(Krauss(), 0.1),
        agent,
        Followers(batch, torch.zeros(3).long()),
        torch.full((3,), 250),
    )
    found = loop.parameters[:, -1, 0]
    torch.testing.assert_close(found, true[:, 0], atol=0.05, rtol=0.0)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_what_the_policy_itself_drives_changes_no_estimate(name: str) -> None:
    batch, _, _ = krauss_drivers()
    agent = agent_of(ESTIMATORS[name], Krauss(), torch.tensor([[1.5, 0.15]]).double())
    loop = simulate_closed_loop(
        MemoryStepper(Krauss(), 0.1),
        agent,
        Followers(batch, torch.zeros(3).long()),
        torch.full((3,), 200),
    )
    assert torch.equal(loop.parameters, loop.parameters[:, :1].expand_as(loop.parameters))


@pytest.mark.parametrize("name", ESTIMATORS)
def test_without_history_a_driver_has_the_pooled_parameters(name: str) -> None:
    batch, _, _ = krauss_drivers()
    prior = torch.tensor([[1.2, 0.3]], dtype=torch.float64)
    agent = agent_of(ESTIMATORS[name], Krauss(), prior)
    loop = simulate_closed_loop(
        MemoryStepper(Krauss(), 0.1),
        agent,
        Followers(batch, torch.zeros(3).long()),
        torch.zeros(3).long(),
    )
    wide = 0.0
    if name == "particle_filter":
        wide = 0.2  # the mean of two hundred draws around it
    torch.testing.assert_close(loop.parameters[:, -1], prior.expand(3, -1), atol=wide, rtol=1e-6)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_origins_that_share_their_observation_are_as_each_alone(name: str) -> None:
    batch, _, _ = krauss_drivers(150)
    agent = agent_of(ESTIMATORS[name], Krauss(), torch.tensor([[1.5, 0.15]]).double())
    stepper, network = MemoryStepper(Krauss(), 0.1), torch.zeros(3).long()
    origins = Origins(torch.tensor([0, 0, 2]), torch.tensor([40, 90, 65]))
    paths = simulate_from_origins(stepper, agent, Followers(batch, network), origins, 30)
    for k, (pair, frame) in enumerate(zip(origins.pair, origins.frame, strict=True)):
        alone = simulate_closed_loop(
            stepper, agent, Followers(batch[pair[None]], network[:1]), frame[None]
        )
        torch.testing.assert_close(paths.speed[k], alone.speed[0, :31], atol=2e-3, rtol=0)


def test_recalibration_is_the_calibration_of_the_latest_history() -> None:
    """The calibrator, given the last ten seconds alone, finds the same parameters."""
    batch, pairs, _ = krauss_drivers()
    until, kept = 250, 101
    policy = RecalibratePolicy(prior=0.0, optimizer={"name": "gradient", "samples": 512})
    default = Krauss().space.defaults()
    agent = agent_of(policy, Krauss(), default[None])
    loop = simulate_closed_loop(
        MemoryStepper(Krauss(), 0.1),
        agent,
        Followers(batch, torch.zeros(3).long()),
        torch.full((3,), until),
    )
    cut = []
    for pair in pairs:
        signals = {name: getattr(pair, name)[until + 1 - kept : until + 1] for name in RECORDED}
        cut.append(type(pair)(**{**vars(pair), **signals}))
    latest = PairSet(tuple(cut), "the latest history")
    calibrator = Calibrator(
        Solver(MemoryStepper(Krauss(), 0.1), GradientSearch(samples=512), seed=0, memory=1 << 28),
        cache=Cache(None),
    )
    found = calibrator.driver_specific(latest, PairBatch.of(latest), torch.full((3,), kept - 1))
    torch.testing.assert_close(loop.parameters[:, -1], found, atol=1e-3, rtol=1e-3)


def test_any_optimizer_recalibrates() -> None:
    batch, _, true = krauss_drivers()
    policy = RecalibratePolicy(prior=0.0, optimizer={"name": "random", "samples": 2048})
    agent = agent_of(policy, Krauss(), torch.tensor([[1.5, 0.15]]).double())
    loop = simulate_closed_loop(
        MemoryStepper(Krauss(), 0.1),
        agent,
        Followers(batch, torch.zeros(3).long()),
        torch.full((3,), 250),
    )
    torch.testing.assert_close(loop.parameters[:, -1, 0], true[:, 0], atol=0.1, rtol=0.0)


def test_a_strong_prior_keeps_the_pooled_parameters() -> None:
    batch, _, _ = krauss_drivers()
    prior = torch.tensor([[1.5, 0.15]], dtype=torch.float64)
    agent = agent_of(RecalibratePolicy(prior=1e4), Krauss(), prior)
    loop = simulate_closed_loop(
        MemoryStepper(Krauss(), 0.1),
        agent,
        Followers(batch, torch.zeros(3).long()),
        torch.full((3,), 250),
    )
    torch.testing.assert_close(loop.parameters[:, -1], prior.expand(3, -1), atol=1e-3, rtol=0)


def test_extreme_driving_leaves_estimates_within_their_bounds() -> None:
    """A recording with jumps is no driver at all; the estimate is some parameters, never NaN."""
    batch, _, _ = krauss_drivers(200)
    jumpy = batch.follower_speed.clone()
    jumpy[:, ::7] += 25.0
    wrong = replace(batch, follower_speed=jumpy)
    low, high = IDM().space.bounds()
    for policy in ESTIMATORS.values():
        agent = agent_of(policy, IDM(), IDM().space.defaults()[None])
        loop = simulate_closed_loop(
            MemoryStepper(IDM(), 0.1),
            agent,
            Followers(wrong, torch.zeros(3).long()),
            torch.full((3,), 150),
        )
        assert bool(((loop.parameters >= low) & (loop.parameters <= high)).all())


@pytest.mark.parametrize("residual", [False, True])
def test_with_a_residual_a_forecast_starts_with_the_drivers_acceleration(residual: bool) -> None:
    """However wrong the parameters are; after ten seconds nothing of it is left."""
    batch, _, _ = krauss_drivers()
    model = IDM()
    agent = agent_of(UkfPolicy(), model, model.space.defaults()[None])
    head = head_class("direct_residual" if residual else "direct").for_model(model)
    agent = replace(
        agent, core=AgentCore(agent.core.policy, agent.core.network, agent.core.scaler, head)
    )
    origins = Origins(torch.tensor([0, 1, 2]), torch.tensor([100, 120, 150]))
    paths = simulate_from_origins(
        MemoryStepper(model, 0.1), agent, Followers(batch, torch.zeros(3).long()), origins, 1
    )
    first = (paths.speed[:, 1] - paths.speed[:, 0]) / 0.1
    driver = batch.follower_acceleration[origins.pair, origins.frame].clamp(-9.0, 2.6)
    assert torch.allclose(first, driver, atol=1e-9) == residual


def test_a_model_without_equations_is_refused() -> None:
    vtype = pytest.importorskip("cfx_sumo.vtype", reason="SUMO alone knows EIDM's equations")
    model = vtype.SumoVType(
        car_follow_model="EIDM", parameters={"tau": {"low": 0.5, "high": 3, "default": 1}}
    )
    with pytest.raises(ConfigError, match="equations in"):
        UkfPolicy().for_model(model, 0.1, WINDOWS)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_an_estimator_is_saved_and_loaded(name: str, tmp_path: Path) -> None:
    batch, _, _ = krauss_drivers(150)
    policy = ESTIMATORS[name]
    agent = agent_of(policy, Krauss(), torch.tensor([[1.5, 0.15]]).double())
    head = head_class("direct_residual").for_model(Krauss())
    agent = replace(
        agent,
        core=AgentCore(agent.core.policy, agent.core.network, agent.core.scaler, head),
        policy_node={"name": name, **policy.settings.model_dump(), "residual": True},
    )
    checkpoint.save_agent(agent, tmp_path)
    speeds = []
    for one in (agent, checkpoint.load_agent(tmp_path)):
        loop = simulate_closed_loop(
            MemoryStepper(Krauss(), 0.1),
            one,
            Followers(batch, torch.zeros(3).long()),
            torch.full((3,), 100),
        )
        speeds.append(loop.speed)
    assert torch.equal(*speeds)


def test_the_policy_says_whether_it_starts_with_a_residual() -> None:
    assert UkfPolicy(residual=True).untrained_head == "direct_residual"
    assert UkfPolicy().untrained_head is None
