"""Where Hydra looks for launchers: `hydra/launcher=dask`."""

from hydra.core.config_store import ConfigStore

from cfx_dask.launcher import EngineLauncher
from cfx_dask.settings import DaskLauncherSettings


class DaskLauncher(EngineLauncher):
    """Runs the jobs of a sweep on a Dask cluster."""


ConfigStore.instance().store(
    group="hydra/launcher", name="dask", node=DaskLauncherSettings, provider="cfx-dask"
)
