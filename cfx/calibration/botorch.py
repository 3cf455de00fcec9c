"""Bayesian optimisation of many independent problems as one batch.

Each problem has a Gaussian process and LogEI of its own.

Model, likelihood, prior, standardisation, fitting loop and acquisition function are BoTorch's and
GPyTorch's own:

- S. Ament et al. (2023), *Unexpected improvements to expected improvement for Bayesian
  optimization* (LogEI).
- C. Hvarfner, E. O. Hellsten and L. Nardi (2024), *Vanilla Bayesian optimization performs great in
  high dimensions* (the lengthscale prior, which `SingleTaskGP` uses by default).
- R. G. Regis and C. A. Shoemaker (2013), *Combining radial basis function surrogates and dynamic
  coordinate search in high-dimensional expensive black-box optimization* (candidates that change
  only some coordinates of the best point).
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from typing import Any, ClassVar

import torch
from botorch.acquisition.analytic import LogExpectedImprovement
from botorch.models import SingleTaskGP
from botorch.models.model import Model
from botorch.models.transforms.outcome import Standardize
from botorch.optim.fit import fit_gpytorch_mll_torch
from botorch.posteriors.posterior import Posterior
from gpytorch.constraints import GreaterThan
from gpytorch.distributions import MultivariateNormal
from gpytorch.kernels import Kernel, MaternKernel
from gpytorch.means import ConstantMean, Mean
from gpytorch.mlls import ExactMarginalLogLikelihood
from gpytorch.priors import LogNormalPrior
from gpytorch.settings import max_eager_kernel_size
from linear_operator.operators import DiagLinearOperator
from linear_operator.settings import cholesky_max_tries
from linear_operator.utils.warnings import NumericalWarning
from pydantic import Field
from torch import Tensor

from cfx.calibration.optimizers import AT_ONCE, CandidateLosses, Optimizer, check_room, sobol
from cfx.core.component import Settings

_NOISE = 1e-6
"""Variance of the standardised values: a simulation has no noise, this only keeps matrices positive
definite."""

_LEARNING_RATE = 0.2
"""Of Adam on the logarithm of lengthscales, where a step means a factor."""

_NEAR_STEPS = (0.01, 0.5)
"""Standard deviations of the steps away from the best point, in unit space; drawn uniformly in the
logarithm."""

_COORDINATES_CHANGED = 3
"""On average, in a candidate near the best point. Few parameters matter at a time: which, depends
on the regime of the window."""


class BotorchSettings(Settings):
    """Settings of `BotorchOptimizer`."""

    initial: int = Field(
        10,
        ge=1,
        description="evaluations before the first Gaussian process: the guesses, then Sobol points",
    )
    iterations: int = Field(
        30,
        ge=0,
        description="evaluations chosen by Gaussian process and LogEI, one after the other",
    )
    screening: int = Field(
        2048,
        ge=0,
        description="further Sobol points evaluated at the start; the first Gaussian process sees"
        " the best of them. Nearly free where simulation is batched, and w99 needs it; 0 where each"
        " evaluation is expensive",
    )
    first_fit_steps: int = Field(
        60, ge=1, description="steps of Adam in the first fit of a Gaussian process"
    )
    fit_steps: int = Field(
        10, ge=1, description="steps of Adam after each evaluation, from the last lengthscales on"
    )
    raw_samples: int = Field(
        512,
        ge=2,
        description="points where LogEI is compared: a quarter anywhere, the rest near the best",
    )
    restarts: int = Field(4, ge=1, description="best of these points from which LogEI is climbed")
    climb_steps: int = Field(
        15, ge=0, description="steps of each climb; 0 takes the best of the raw samples"
    )


class BotorchOptimizer(Optimizer):
    """Gaussian-process optimisation of all problems of a shard at once.

    One candidate of each problem is evaluated per iteration (q = 1). First, guesses and Sobol
    points are evaluated, `initial` in all. Then, `iterations` times, a Gaussian process is fitted
    to everything seen, and the candidate with the greatest expected improvement is evaluated.

    What makes it work on losses of trajectories:

    - The process models `-log sqrt(loss^2 + best^2)`. Losses span orders of magnitude with a kink
      at the optimum; this magnifies the neighbourhood of the best loss down to its own size and no
      further, so that it stays smooth there.
    - Matern 3/2: driving models switch between regimes, so losses have kinks.
    - Noise is fixed at almost nothing: the prior on noise that suits experiments blurs a
      simulation's narrow valleys.

    What makes it fast: one model with a batch of P Gaussian processes; marginal variances only; a
    few steps of Adam from the last lengthscales instead of a fit from scratch (BoTorch's batched
    L-BFGS costs ten times as much and finds no better losses). Every sum over problems separates,
    and the numbers of steps are fixed, so problems do not influence each other.

    Robust by construction: diverged candidates count as the worst finite loss of their problem; a
    constant objective standardises to zeros; duplicates are carried by the noise; candidates are
    clamped.
    """

    schema: ClassVar[type[Settings]] = BotorchSettings
    settings: BotorchSettings
    trial: ClassVar[Mapping[str, Any]] = {
        "initial": 6,
        "iterations": 3,
        "screening": 200,
        "first_fit_steps": 5,
        "fit_steps": 4,
        "raw_samples": 64,
        "restarts": 2,
        "climb_steps": 3,
    }
    in_shards = True

    def evaluations(self, n: int) -> int:
        return self.space_filling(n) + self.settings.iterations

    def space_filling(self, n: int) -> int:
        return self.settings.screening + self.settings.initial

    def evaluations_at_once(self, n: int) -> int:
        return min(AT_ONCE, self.space_filling(n))

    def bytes_per_problem(self, n: int) -> int:
        # Measured: a fit holds about 24 matrices (seen, seen) for its gradient, LogEI about 8 of
        # (raw samples, seen).
        evaluated = self.settings.initial + self.settings.iterations
        query = self.settings.raw_samples * (8 * evaluated + 6 * n)
        climb = self.settings.restarts * (24 * evaluated + 12 * n)
        return 8 * (max(query, climb, 24 * evaluated * evaluated) + 8 * evaluated * n)

    def solve(
        self, objective: CandidateLosses, guesses: Tensor, *, seed: int
    ) -> tuple[Tensor, Tensor]:
        settings = self.settings
        problems, g, n = guesses.shape
        check_room(settings.initial, g, key="initial")
        points = sobol(self.space_filling(n) - g, n, seed=seed, device=guesses.device)
        tried = torch.cat([guesses, points.expand(problems, -1, -1)], dim=1)
        losses = objective(tried)
        search = _BatchSearch(settings, tried, losses, guesses=g, seed=seed)
        for _ in range(settings.iterations):
            candidate = search.ask()
            loss = objective(candidate)
            search.tell(candidate, loss)
            tried, losses = torch.cat([tried, candidate], dim=1), torch.cat([losses, loss], dim=1)
        return tried, losses


class _BatchSearch:
    """The Gaussian processes of a shard of problems: their evaluations and next candidates."""

    def __init__(
        self, settings: BotorchSettings, tried: Tensor, losses: Tensor, *, guesses: int, seed: int
    ) -> None:
        self._settings = settings
        self._generator = torch.Generator().manual_seed(seed)
        best = _best_of(losses, guesses, settings.initial)
        self._seen = tried.gather(1, best[..., None].expand(-1, -1, tried.shape[-1]))
        self._losses = losses.gather(1, best)
        batch = torch.Size([tried.shape[0]])
        self._mean = ConstantMean(batch_shape=batch).to(tried)
        self._kernel = _kernel(tried.shape[-1], batch).to(tried)
        self._fits = 0

    def tell(self, candidate: Tensor, loss: Tensor) -> None:
        """Adds evaluated candidates `(P, 1, n)` and their losses `(P, 1)`."""
        self._seen = torch.cat([self._seen, candidate], dim=1)
        self._losses = torch.cat([self._losses, loss], dim=1)

    def ask(self) -> Tensor:
        """Returns the candidates `(P, 1, n)` with the greatest expected improvement."""
        standardize = Standardize(1, batch_shape=self._seen.shape[:1])
        values, _ = standardize(_values(self._losses)[..., None])
        steps = self._settings.fit_steps
        if self._fits == 0:
            steps = self._settings.first_fit_steps
        with _quiet_and_patient():
            process = _MarginalGP(self._seen, values, self._mean, self._kernel)
            _fit(process, steps)
            self._fits += 1
            improvement = LogExpectedImprovement(_Marginals(process), best_f=values.amax(dim=1))
            return self._maximise(improvement)

    def _maximise(self, improvement: LogExpectedImprovement) -> Tensor:
        """Returns `(P, 1, n)`: the best raw samples, improved by Adam, each problem on its own."""
        with torch.no_grad():
            raw = self._raw_samples()
            value = improvement(raw[..., None, :])
        value, index = value.topk(min(self._settings.restarts, len(raw)), dim=0)
        start = raw.gather(0, index[..., None].expand(-1, -1, raw.shape[-1]))
        if self._settings.climb_steps:
            climbed = start.clone().requires_grad_()
            adam = torch.optim.Adam([climbed], lr=0.01)
            for _ in range(self._settings.climb_steps):
                (climbed.grad,) = torch.autograd.grad(
                    -improvement(climbed[..., None, :]).sum(), climbed
                )
                adam.step()
                with torch.no_grad():
                    climbed.clamp_(0.0, 1.0)
            with torch.no_grad():
                reached = improvement(climbed[..., None, :])
            # Written so that a climb that ends in NaN counts as no climb.
            better = reached > value
            start = torch.where(better[..., None], climbed.detach(), start)
            value = torch.where(better, reached, value)
        chosen = value.argmax(dim=0)
        return start.gather(0, chosen[None, :, None].expand(1, -1, start.shape[-1])).transpose(0, 1)

    def _raw_samples(self) -> Tensor:
        """Returns `(raw_samples, P, n)`: points anywhere and points near each problem's best.

        The random numbers are the same in every problem.
        """
        problems, _, n = self._seen.shape
        everywhere = self._settings.raw_samples // 4
        near = self._settings.raw_samples - everywhere
        draw = partial(torch.rand, generator=self._generator, dtype=torch.float64)
        low, high = math.log(_NEAR_STEPS[0]), math.log(_NEAR_STEPS[1])
        size = torch.exp(low + (high - low) * draw(near, 1))
        changed = draw(near, n) < min(1.0, _COORDINATES_CHANGED / n)
        changed[torch.arange(near), torch.randint(n, (near,), generator=self._generator)] = True
        step = torch.randn(near, n, generator=self._generator, dtype=torch.float64) * size * changed
        best = self._seen.gather(1, self._losses.argmin(dim=1)[:, None, None].expand(-1, 1, n))
        anywhere = draw(everywhere, 1, n).to(best.device).expand(-1, problems, -1)
        return torch.cat(
            [anywhere, (best.transpose(0, 1) + step[:, None].to(best.device)).clamp(0.0, 1.0)]
        )


def _best_of(losses: Tensor, guesses: int, count: int) -> Tensor:
    """Returns `(P, count)`: indices of the guesses and of the best of the other evaluations."""
    first = torch.arange(guesses, device=losses.device).expand(len(losses), -1)
    others = losses[:, guesses:].sort(dim=1, stable=True).indices[:, : count - guesses] + guesses
    return torch.cat([first, others.sort(dim=1).values], dim=1)


def _values(losses: Tensor) -> Tensor:
    """Returns what the Gaussian process models, `(P, e)`: `-log sqrt(excess^2 + scale^2)`.

    For losses that are not negative, the excess is the loss and the scale is the best loss (at
    least a ten-thousandth of the median). Otherwise the excess is taken over the best loss, and the
    scale is a tenth of its median.
    """
    finite = losses.isfinite()
    worst = losses.where(finite, -torch.inf).amax(dim=1, keepdim=True)
    losses = losses.where(finite, worst).where(worst.isfinite(), 0.0)
    # Half the losses' difference is finite where the difference is not; the logarithm does not mind
    # the factor.
    lowest = 0.5 * losses.amin(dim=1, keepdim=True)
    excess = 0.5 * losses - lowest.clamp(max=0.0)
    median = excess.median(dim=1, keepdim=True).values
    scale = torch.where(
        lowest > 0,
        torch.maximum(lowest, 1e-4 * median),
        torch.where(lowest < 0, 0.1 * median, 1e-4 * median),
    )
    return -torch.hypot(excess, scale).clamp(min=1e-200).log()


def _kernel(n: int, batch: torch.Size) -> Kernel:
    """Returns a Matern 3/2 kernel with one lengthscale per parameter and Hvarfner et al.'s prior.

    As BoTorch's `get_covar_module_with_dim_scaled_prior`, but for the smoothness, and fitted in the
    logarithm of the lengthscale.
    """
    prior = LogNormalPrior(loc=math.sqrt(2) + 0.5 * math.log(n), scale=math.sqrt(3))
    constraint = GreaterThan(
        2.5e-2, transform=torch.exp, inv_transform=torch.log, initial_value=prior.mode
    )
    return MaternKernel(
        nu=1.5,
        ard_num_dims=n,
        batch_shape=batch,
        lengthscale_prior=prior,
        lengthscale_constraint=constraint,
    )


def _fit(process: SingleTaskGP, steps: int) -> None:
    """Takes a fixed number of steps.

    A stopping rule would look at the sum over problems and couple them.
    """
    likelihood = ExactMarginalLogLikelihood(process.likelihood, process).train()
    before = {}
    for name, parameter in process.named_parameters():
        before[name] = parameter.detach().clone()
    adam = partial(torch.optim.Adam, lr=_LEARNING_RATE)
    fit_gpytorch_mll_torch(likelihood, step_limit=steps, stopping_criterion=None, optimizer=adam)
    with torch.no_grad():
        for name, parameter in process.named_parameters():
            parameter.copy_(torch.where(parameter.isfinite(), parameter, before[name]))
    likelihood.eval()


@contextmanager
def _quiet_and_patient() -> Iterator[None]:
    """Lets the Cholesky decomposition add jitter as often as it takes, without a warning.

    Jitter is added to the matrices alone that need it.
    """
    with cholesky_max_tries(9), warnings.catch_warnings():
        warnings.simplefilter("ignore", NumericalWarning)
        yield


class _MarginalGP(SingleTaskGP):
    """A `SingleTaskGP` of P problems, queried at `(P, m, n)`, that gives the m marginals alone.

    GPyTorch's own posterior would evaluate the covariance of the queries among each other, most of
    the work, for its diagonal.
    """

    def __init__(self, seen: Tensor, values: Tensor, mean: Mean, kernel: Kernel) -> None:
        noise = torch.full_like(values, _NOISE)
        super().__init__(
            seen, values, noise, mean_module=mean, covar_module=kernel, outcome_transform=None
        )

    def _get_test_prior_mean_and_covariances(
        self, train_inputs: Any, test_inputs: Any, **_: Any
    ) -> Any:
        (seen,), (query,) = train_inputs, test_inputs
        among = DiagLinearOperator(self.covar_module(query, diag=True))
        to_seen = self.covar_module(query, seen).evaluate_kernel()
        return (
            self.mean_module(query),
            among,
            to_seen,
            query.shape[:-2],
            query.shape[-2:-1],
            MultivariateNormal,
        )


class _Marginals(Model):
    """Hands queries `(m, P, 1, n)` of acquisition functions to the processes as `(P, m, n)`.

    That is one matrix product for each process.
    """

    def __init__(self, process: _MarginalGP) -> None:
        super().__init__()
        self._process = process

    @property
    def num_outputs(self) -> int:
        return 1

    @property
    def batch_shape(self) -> torch.Size:
        return torch.Size(self._process.batch_shape)

    # X is BoTorch's name, passed as keyword.
    def posterior(self, X: Tensor, *_: Any, **__: Any) -> Posterior:  # noqa: N803
        # Without this, the few queries of a climb would be taken as dense and their diagonal
        # covariance filled up.
        with max_eager_kernel_size(0):
            # (m, P, 1, n) -> (P, m, n), and back: (P, m) -> (m, P, 1).
            posterior = self._process.posterior(X.squeeze(-2).transpose(0, 1))
            mean = posterior.mean.transpose(0, 1)[..., None]
            return _IndependentNormal(mean, posterior.variance.transpose(0, 1)[..., None])


class _IndependentNormal(Posterior):
    """Independent normal distributions: what an analytic acquisition function needs."""

    def __init__(self, mean: Tensor, variance: Tensor) -> None:
        self._mean, self._variance = mean, variance

    @property
    def mean(self) -> Tensor:
        return self._mean

    @property
    def variance(self) -> Tensor:
        return self._variance

    @property
    def device(self) -> torch.device:
        return self._mean.device

    @property
    def dtype(self) -> torch.dtype:
        return self._mean.dtype

    def rsample(self, sample_shape: torch.Size | None = None) -> Tensor:
        shape = (*(sample_shape or ()), *self._mean.shape)
        return self._mean + self._variance.sqrt() * torch.randn(
            shape, dtype=self.dtype, device=self.device
        )
