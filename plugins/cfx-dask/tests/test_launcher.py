"""The launcher keeps Hydra's own contract of launchers, and has every setting of the engine."""

from __future__ import annotations

from dataclasses import fields

import pytest
from hydra.core.plugins import Plugins
from hydra.plugins.launcher import Launcher
from hydra.test_utils.launcher_common_tests import LauncherTestSuite

import cfx
from cfx_dask.settings import DaskLauncherSettings


def test_hydra_finds_it() -> None:
    names = [plugin.__name__ for plugin in Plugins.instance().discover(Launcher)]
    assert "DaskLauncher" in names


def test_its_settings_are_those_of_the_engine() -> None:
    engine = cfx.get("engine", "dask").schema()
    launcher = DaskLauncherSettings()
    names = {one.name for one in fields(launcher)} - {"_target_"}
    assert names == set(type(engine).model_fields)
    differ = {name for name in names if getattr(launcher, name) != getattr(engine, name)}
    assert differ == {"waiting"}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*:UserWarning:hydra")  # Hydra's own tests are of before
@pytest.mark.parametrize(("launcher_name", "overrides"), [("dask", ["hydra.launcher.workers=1"])])
class TestDaskLauncher(LauncherTestSuite):
    pass
