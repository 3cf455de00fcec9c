"""Chains of the No-U-Turn sampler: they are the posterior, and the same ones each time."""

from __future__ import annotations

import pytest
import torch

from cfx.models.idm import IDM
from cfx.models.krauss import Krauss
from cfx_posteriors import nuts
from cfx_posteriors.importance import sample
from cfx_posteriors.laplace import laplace, likely_starts
from cfx_posteriors.nuts import walk

from .recordings import draw_recordings

SHARES = torch.tensor([0.05, 0.5, 0.95], dtype=torch.float64)


@pytest.mark.slow
def test_chains_agree_with_weighted_samples_and_come_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(nuts, "WARM_UP", 100)
    monkeypatch.setattr(nuts, "DRAWS", 200)
    posterior = draw_recordings(Krauss(), 3, frames=300).posterior
    weighted = sample(
        posterior, laplace(posterior, likely_starts(posterior, 0)), SHARES, seed=0, memory=1 << 30
    )
    found = walk(posterior, weighted, SHARES, seed=0, memory=1 << 30)
    n = len(posterior.space)
    deviation = found.draws[..., :n].std(1, keepdim=True)
    apart = (found.quantiles - weighted.quantiles) / deviation
    assert float(apart.abs().max()) < 0.4
    assert float(found.effective.min()) > 100
    assert float(found.diagnostics["r_hat"].max()) < 1.05
    again = walk(posterior, weighted, SHARES, seed=0, memory=1 << 30)
    torch.testing.assert_close(again.draws, found.draws, rtol=0, atol=0)


def test_slopes_are_those_of_the_density_in_any_coordinates() -> None:
    """Slopes in the copula's coordinates, where skewed samples are normal, by central differences."""
    posterior, truth, _ = draw_recordings(IDM(), 2, frames=200)
    generator = torch.Generator().manual_seed(0)
    away = torch.randn((2, 200, 6), generator=generator, dtype=torch.float64)
    away[..., 0] = away[..., 0].exp()  # skewed
    away[..., 1] += away[..., 2]
    coordinates = nuts._Coordinates(truth[:, None, :-1] + 0.05 * away)
    place = torch.randn((2, 3, 6), generator=generator, dtype=torch.float64)
    both = torch.arange(2)
    value, slope = coordinates.density(posterior, place, both).split([1, 6], dim=-1)
    assert bool(value.isfinite().all())
    for column in range(6):
        shift = 1e-4 * torch.eye(6, dtype=torch.float64)[column]
        high = coordinates.density(posterior, place + shift, both)[..., 0]
        low = coordinates.density(posterior, place - shift, both)[..., 0]
        torch.testing.assert_close(slope[..., column], (high - low) / 2e-4, rtol=1e-2, atol=1e-2)


def test_a_coordinate_that_ends_like_a_wall_is_normal() -> None:
    generator = torch.Generator().manual_seed(0)
    samples = torch.rand((1, 400, 2), generator=generator, dtype=torch.float64)
    samples[..., 1] = -torch.log(samples[..., 1])
    coordinates = nuts._Coordinates(samples)
    normal = torch.randn((1, 20_000, 2), generator=generator, dtype=torch.float64)
    found, rate, _ = coordinates.outer(normal)
    assert float(rate.min()) > 0.0
    wanted = torch.stack([SHARES, -torch.log1p(-SHARES)], dim=1)
    torch.testing.assert_close(found[0].quantile(SHARES, dim=0), wanted, atol=0.12, rtol=0.12)


def test_drivers_whose_trees_are_finished_are_not_simulated(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    posterior = draw_recordings(Krauss(), 3, frames=100).posterior
    samples = torch.randn((3, 50, 3), generator=torch.Generator().manual_seed(0)).double()
    density = nuts._Density(posterior, nuts._Coordinates(samples))
    place = torch.zeros((3, nuts.CHAINS, 3), dtype=torch.float64)

    def ask() -> torch.Tensor:
        halves = place.numpy().copy()[..., None].view("uint32")
        return torch.from_numpy(density(halves).view("float64")[..., 0].copy())  # type: ignore[arg-type]  # JAX's array, or NumPy's

    first = ask()
    simulated: list[int] = []
    of_some = nuts._Coordinates.density

    def counting(self: nuts._Coordinates, *asked: object) -> torch.Tensor:
        simulated.append(len(asked[2]))  # type: ignore[arg-type]  # the drivers
        return of_some(self, *asked)  # type: ignore[arg-type]  # as they came

    monkeypatch.setattr(nuts._Coordinates, "density", counting)
    torch.testing.assert_close(ask(), first)
    place[1, 2] += 0.1
    moved = ask()
    assert simulated == [1]
    changed = ~torch.isclose(moved, first).all(-1)
    assert changed.nonzero().tolist() == [[1, 2]]
