"""`cfx export --to netcdf`: a job's posteriors as ArviZ and other programs read them.

The file follows ArviZ's InferenceData: groups of labelled arrays, with a chain and a draw. Weighted
samples are one chain, since they are independent.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import cast

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray

from cfx.errors import DataError
from cfx.plugin import (
    DrivingModel,
    ExportFormat,
    files,
    folder_of,
    job_folder,
    registry,
    stored_tables,
)

NAME = "posterior.nc"

_PARAMETER = "parameter_"
_DIAGNOSTICS = {
    "pareto_k": "above 0.7 a driver's draws are not to be relied on",
    "expected_coverage": "share of simulated drivers' parameters that 90 % intervals of the network"
    " hold",
    "r_hat": "above 1.05 a driver's chains differ",
    "divergences": "share of the draws; above 0.01 chains may have left out a part",
    "effective_samples": "effective sample size that the draws rest on",
    "noise_scale": "what each step of the noise adds",
    "noise_correlation": "of the noise with itself one step later",
    "noise_gain": "the driver's own share of the noise, 0 to 1",
    "likelihood_power": "power with which the likelihood counts",
    "held": "share of the held-out steps that forecasts hold; 0.9 is right",
    "held_chance": "below 0.05 forecasts miss more of the held-out part than chance allows",
}


class NetcdfExport(ExportFormat):
    """Writes draws of each driver's parameters, of the prior or the population, and diagnostics."""

    def write(self, run: str, output: Path | None) -> list[str]:
        """Writes `posterior.nc`.

        Raises:
            DataError: the job has no posterior.
            OutputError: the file cannot be written.
        """
        folder = folder_of(run)
        if output is None:
            output = (folder if Path(run).expanduser().is_dir() else Path()) / NAME
        tables = stored_tables(folder)
        if "posterior" not in tables or "fits" not in tables:
            raise DataError(
                f"{run}: this job has found no posterior; run one with"
                " calibration.posterior=laplace, nuts, sbi or hierarchical"
            )
        node = job_folder.read_yaml(folder / "config.yaml")["model"]
        fits = tables["fits"].query("method == 'driver_specific'").set_index("pair_id")
        tree = inference_data(tables, fits, cast(DrivingModel, registry.create("model", node)))
        with tempfile.TemporaryDirectory(prefix="cfx-") as name:
            path = Path(name, NAME)
            tree.to_netcdf(path, engine="h5netcdf")
            content = path.read_bytes()
        files.write_output(output, content, "the posterior")
        sizes = tree["posterior"].sizes
        return [
            f"{output}: {sizes['chain'] * sizes['draw']} draws for each of {sizes['pair']} pairs,"
            f" groups {', '.join(tree.children)}",
            f'Read it: xarray.open_datatree("{output}"); ArviZ takes what that returns',
        ]


def inference_data(
    tables: Mapping[str, pd.DataFrame], fits: pd.DataFrame, model: DrivingModel
) -> xr.DataTree:
    """Returns posteriors as labelled arrays.

    Args:
        tables: `posterior`, and `prior` or `population`.
        fits: diagnostics, a row per pair_id.
        model: whose parameters they are.

    Returns:
        `posterior`: (chain, draw, pair); `prior` or `population`: (chain, draw), drivers who were
        not recorded; `diagnostics`: (pair). Values of parameters are in SI units.
    """
    draws = tables["posterior"]
    pairs = draws["pair_id"].drop_duplicates().tolist()
    names = [name for name in draws.columns if name.startswith(_PARAMETER)]
    groups = {"posterior": _dataset(draws, names, model, pairs)}
    for kind in ("prior", "population"):
        if kind in tables:
            groups[kind] = _dataset(tables[kind], names, model, None)
    rows = fits.loc[pairs]
    diagnostics = {}
    for name, meaning in _DIAGNOSTICS.items():
        if name not in rows:
            continue
        diagnostics[name] = ("pair", rows[name].to_numpy(np.float64), {"long_name": meaning})
    groups["diagnostics"] = xr.Dataset(diagnostics, coords={"pair": pairs})
    return xr.DataTree.from_dict(groups)


def _dataset(
    table: pd.DataFrame, names: Sequence[str], model: DrivingModel, pairs: Sequence[str] | None
) -> xr.Dataset:
    """Returns draws of parameters, of some pairs or of nobody in particular."""
    # A pair stands after the other, each with its chains, and they with their draws.
    chains = table["chain"].nunique() if "chain" in table else 1
    dims: tuple[str, ...] = ("chain", "draw")
    if pairs is not None:
        dims = (*dims, "pair")
    variables = {}
    for name in names:
        values: NDArray[np.float64] = table[name].to_numpy(np.float64)
        if pairs is None:
            values = values.reshape(chains, -1)
        else:
            values = np.moveaxis(values.reshape(len(pairs), chains, -1), 0, -1)
        parameter = model.space[name.removeprefix(_PARAMETER)]
        about = {"units": parameter.unit, "long_name": parameter.meaning}
        variables[parameter.name] = (dims, values, about)
    draws = len(table) // (chains if pairs is None else chains * len(pairs))
    coords: dict[str, object] = {"chain": np.arange(chains), "draw": np.arange(draws)}
    if pairs is not None:
        coords["pair"] = list(pairs)
    return xr.Dataset(variables, coords=coords)
