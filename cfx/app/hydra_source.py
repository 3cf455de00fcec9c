"""How installed components become Hydra's config options: the source `cfx://` and the search path.

The search path is: Hydra's own, `conf/` of cfx, the `conf/` folder in each plugin's package, and
last `cfx://`. That source lists every component by the metadata of its distribution and imports
only the one that is chosen. So a plugin's own YAML wins over the node written from its class. That
node stays available as `_NAME` in a defaults list:

    # my_package/conf/model/mine.yaml: the generated node with another default
    defaults: [_mine, _self_]
    parameters: {tau: {default: 1.2}}
"""

from __future__ import annotations

import importlib.util
import logging
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import hydra
import hydra.utils
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.utils import create_config_search_path
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.hydra_config import HydraConfig
from hydra.core.object_type import ObjectType
from hydra.core.plugins import Plugins
from hydra.core.singleton import Singleton
from hydra.core.utils import setup_globals
from hydra.plugins.config_source import ConfigLoadError, ConfigResult, ConfigSource
from hydra.plugins.search_path_plugin import SearchPathPlugin
from hydra.types import RunMode
from hydra.version import VersionBase
from omegaconf import DictConfig, OmegaConf
from packaging.version import Version

from cfx.app import nodes
from cfx.core import registry
from cfx.core.distributions import OWN
from cfx.errors import PluginError

if TYPE_CHECKING:
    from cfx.core.command import Command

log = logging.getLogger(__name__)

VERSION_BASE = "1.3"
"""Version of Hydra whose defaults configurations are composed with."""

_HYDRA = threading.RLock()
"""Held for the tenths of a second in which a configuration is composed or resolved."""


class ComponentSource(ConfigSource):
    """Serves `cfx://`: one config group per kind, one option per component."""

    @staticmethod
    def scheme() -> str:
        return "cfx"

    def available(self) -> bool:
        return True

    def is_group(self, config_path: str) -> bool:
        return config_path.strip("/") in {"", *registry.GROUPS}

    def is_config(self, config_path: str) -> bool:
        group, name = _split(config_path)
        return group in registry.GROUPS and name.removeprefix("_") in registry.names(group)

    def list(self, config_path: str, results_filter: ObjectType | None) -> list[str]:
        path = config_path.strip("/")
        if path == "" and results_filter != ObjectType.CONFIG:
            return sorted(registry.GROUPS)
        if path in registry.GROUPS and results_filter != ObjectType.GROUP:
            return list(registry.names(path))
        return []

    def load_config(self, config_path: str) -> ConfigResult:
        """Imports the chosen component and writes its node.

        Raises:
            PluginError: the component cannot be loaded, or two distributions claim its name.
        """
        group, name = _split(config_path)
        if not self.is_config(config_path):
            raise ConfigLoadError(f"Config not found: {config_path}")
        name = name.removeprefix("_")
        text = nodes.render(registry.get(group, name), name)
        return ConfigResult(
            provider=self.provider,
            path="cfx://",
            config=OmegaConf.create(text),
            header={"package": None},
        )


class ComponentSearchPath(SearchPathPlugin):
    """Appends each plugin's `conf/` and then `cfx://` to Hydra's search path."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        # A file of such a name on the search path would replace Hydra's own. Hydra has most of them
        # in its folder `conf`; three are defined in its code.
        in_code = {"hydra/config.yaml", "hydra/launcher/basic.yaml", "hydra/sweeper/basic.yaml"}
        of_hydra = Path(hydra.__file__).parent / "conf"
        for package, folder in plugin_conf_dirs().items():
            replaced = []
            for path in sorted(folder.rglob("*.yaml")):
                name = path.relative_to(folder).as_posix()
                if name in in_code or (of_hydra / name).is_file():
                    replaced.append(name)
            if replaced:
                log.warning(
                    "The plugin %s brings %s, which would replace Hydra's own; its folder %s is"
                    " left out: repair that package, or uninstall it",
                    package,
                    ", ".join(replaced),
                    folder,
                )
                continue
            search_path.append(package, f"file://{folder}")
        search_path.append("cfx", "cfx://")


def plugin_conf_dirs() -> dict[str, Path]:
    """Returns the `conf/` folder of every third party's top-level package that has one.

    Runs no code of theirs.
    """
    packages = set()
    for kind in registry.KINDS:
        for entry in registry.entries(kind):
            packages.add(entry.package)
    folders: dict[str, Path] = {}
    for package in sorted(packages - {"cfx"}):
        with suppress(ImportError, ValueError):  # a broken distribution harms nobody else
            spec = importlib.util.find_spec(package)
            for location in (spec and spec.submodule_search_locations) or ():
                folder = Path(location) / "conf"
                if folder.is_dir():
                    folders.setdefault(package, folder)
    return folders


def register() -> None:
    """Makes both, and the list of sub-commands, known to Hydra.

    Call it before Hydra composes anything; doing it twice does no harm.
    """
    plugins = Plugins.instance()
    if not OmegaConf.has_resolver("hydra"):
        setup_globals()  # the resolvers `hydra` and `now`, which Hydra's applications have
    plugins.register(ComponentSource)
    plugins.register(ComponentSearchPath)
    OmegaConf.register_new_resolver("cfx_commands", listed_commands, replace=True)
    OmegaConf.register_new_resolver("cfx_recorded", of_recordings, replace=True)


def of_recordings(duration: float, *, _root_: DictConfig) -> float:
    """Returns `data.min_duration` of a preset, s: 0 where the job simulates its pairs itself.

    How long simulated pairs are the job says itself.
    """
    return duration if "path" in _root_.data else 0.0


def listed_commands() -> str:
    """Returns a line for each sub-command, as `--help` prints them; nothing where nobody asks.

    Hydra fills in its help of every job; a third party's command is imported for it here alone.
    """
    if not {"--help", "-h"}.intersection(sys.argv):
        return ""
    lines = []
    for name in registry.names("command"):
        try:
            about = cast("type[Command]", registry.get("command", name)).summary
            distribution = registry.entry("command", name).distribution
            if distribution != OWN:
                about = f"{about} (from {distribution})".strip()
        except PluginError as error:  # it cannot be imported, or two distributions bring it
            about = str(error)
        lines.append(f"  cfx {name.replace('.', ' '):<13} {about}")
    return "\n".join(lines).replace("$", "$$")  # Hydra fills in what follows a $


def composed(overrides: Sequence[str]) -> DictConfig:
    """Composes a configuration as the command line does, Hydra's own node included.

    A running Hydra application is left alone, and so are other threads: Hydra's `compose` would
    need its one `GlobalHydra`.

    Raises:
        HydraException: an override fits nothing.
        PluginError: a chosen component cannot be loaded.
    """
    base = Version(VERSION_BASE)
    with _for_this_thread(VersionBase, "version_base", base):
        loader = ConfigLoaderImpl(create_config_search_path(str(nodes.conf_dir())))
        return loader.load_configuration(
            "config", list(overrides), run_mode=RunMode.RUN, from_shell=False
        )


@contextmanager
def resolving(config: DictConfig) -> Iterator[None]:
    """Lets `${hydra:...}` mean this configuration in this thread."""
    holder: HydraConfig = object.__new__(HydraConfig)  # one that is no singleton
    holder.set_config(config)
    with _for_this_thread(HydraConfig, "cfg", holder.cfg):
        yield


@contextmanager
def _for_this_thread(singleton: type, attribute: str, value: Any) -> Iterator[None]:
    """Gives an attribute of one of Hydra's singletons a value that other threads do not see.

    Other threads that run Hydra read and write what the singleton had before.
    """
    instances: dict[Any, Any] = Singleton._instances  # noqa: SLF001 - Hydra has no way to replace one
    thread = threading.get_ident()
    with _HYDRA:
        earlier = instances.get(singleton)
        shared = earlier
        if shared is None:
            shared = object.__new__(singleton)
            shared.__init__()
        initial = dict(vars(shared))

        def read(_: Any) -> Any:
            return value if threading.get_ident() == thread else getattr(shared, attribute)

        def write(_: Any, changed: Any) -> None:
            setattr(shared, attribute, changed)

        # The attribute must be a property, which only a class can have: so the replacement is of a
        # subclass, and `isinstance` holds for it.
        of_thread = type(singleton.__name__, (singleton,), {attribute: property(read, write)})
        replacement: Any = object.__new__(of_thread)
        instances[singleton] = replacement
        try:
            yield
        finally:
            if instances.get(singleton) is replacement:
                instances[singleton] = shared
                # Where there was none, and no other thread has used it, there is none again.
                if earlier is None and vars(shared) == initial:
                    del instances[singleton]


def plain(config: DictConfig) -> dict[str, Any]:
    """Returns the job's part of a composed configuration as plain data, interpolations resolved.

    Raises:
        OmegaConfBaseException: an interpolation leads nowhere.
    """
    groups = [str(key) for key in config if key != "hydra"]
    job = OmegaConf.masked_copy(config, groups)
    with resolving(config):
        return cast("dict[str, Any]", OmegaConf.to_container(job, resolve=True))


def _split(config_path: str) -> tuple[str, str]:
    group, _, name = config_path.strip("/").removesuffix(".yaml").rpartition("/")
    return group, name


# A worker process imports this module with the sources that it is sent, and needs them registered.
register()
