"""SUMO, started in this process (libsumo) or with its window, and its command line."""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from cfx.errors import SumoError


@contextmanager
def started(scenario: Path, command: Sequence[str], gui: bool) -> Iterator[Any]:
    """Starts SUMO for a block; gives its connection.

    Args:
        scenario: for messages.
        command: SUMO's command line.
        gui: whether it is that of SUMO's window.

    Raises:
        SumoError: a simulation is open in this process, which is left as it is; SUMO refuses the
            scenario, or stops in the block.
    """
    try:
        sumo = _window(command) if gui else _in_process(command)
    except Exception as error:
        if not _is_sumos(error):
            raise
        raise SumoError(f"SUMO refuses {scenario}: {_reason(error)}") from error
    try:
        yield sumo
    except Exception as error:
        if not _is_sumos(error):
            raise
        raise SumoError(f"SUMO stopped {scenario}: {_reason(error)}") from error
    finally:
        _close(sumo)


_QUIET = "LIBSUMO_AS_TRACI"

_CHECK_JUNCTIONS = "--collision.check-junctions"


def _in_process(command: Sequence[str]) -> Any:
    """Starts SUMO in this process; returns libsumo, which has room for one simulation."""
    before = os.environ.get(_QUIET)
    # No word about pyarrow, which is not loaded here.
    os.environ.setdefault(_QUIET, "quiet")
    try:
        import libsumo
    finally:
        if before is None:
            del os.environ[_QUIET]
    if libsumo.isLoaded():
        raise SumoError(
            "a simulation is open in this process, and libsumo has room for one; close it first"
            " (libsumo.close()), or run this in a process of its own"
        )
    try:
        libsumo.start(list(command))
    except Exception:
        _close(libsumo)  # what it refuses stays loaded otherwise
        raise
    return libsumo


def _window(command: Sequence[str]) -> Any:
    """Starts SUMO's window; returns a connection beside those that the caller may have."""
    import traci  # type: ignore[import-untyped]  # SUMO brings no types

    label = f"cfx-{secrets.token_hex(4)}"
    traci.start(list(command), label=label, doSwitch=False)
    return traci.getConnection(label)


def _close(sumo: Any) -> None:
    try:
        sumo.close()
    except Exception as error:  # SUMO has gone already; why was said
        if not _is_sumos(error):
            raise


def _is_sumos(error: Exception) -> bool:
    """Says whether an error is SUMO's word; libsumo's and traci's are classes of the same names."""
    return type(error).__name__ in {"TraCIException", "FatalTraCIError"}


def _gui_program() -> str:
    try:
        import sumo  # of the wheel eclipse-sumo, which the extra leaves out for its size

        program = shutil.which("sumo-gui", path=str(Path(sumo.__file__).parent / "bin"))
    except ImportError:
        program = shutil.which("sumo-gui")
    if program is None:
        raise SumoError("--gui needs SUMO's window, sumo-gui: pip install eclipse-sumo")
    return program


def is_set(scenario: Path, options: Sequence[str], name: str) -> bool:
    """Says whether SUMO's configuration or the user's own options set one of SUMO's options."""
    if any(option.partition("=")[0] == f"--{name}" for option in options):
        return True
    try:
        # S314: it is the user's own file, which SUMO reads next.
        return next(ElementTree.parse(scenario).iter(name), None) is not None  # noqa: S314
    except ElementTree.ParseError:
        return True  # SUMO says what is wrong with it


def command_line(
    scenario: Path,
    options: Sequence[str] = (),
    *,
    step: float | None = None,
    seed: int | None = None,
    gui: bool = False,
) -> list[str]:
    """Returns SUMO's command line; the user's own options come last and win.

    Args:
        scenario: SUMO's configuration.
        options: the user's own.
        step: of the simulation, s; None: the configuration's.
        seed: SUMO's; None: the configuration's.
        gui: whether SUMO's window is shown.
    """
    command = ["sumo", "-c", str(scenario)]
    if gui:
        command[0] = _gui_program()
        command += ["--start", "--quit-on-end", "--delay", "100"]
    # SUMO does not look for collisions at junctions unless it is told to.
    switches = ("--no-step-log", "--duration-log.disable", "--no-warnings", _CHECK_JUNCTIONS)
    set_by_user = {option.partition("=")[0] for option in options}
    for name in switches:
        if name not in set_by_user:
            command += [name, "true"]
    if step is not None:
        command += ["--step-length", f"{step:g}"]
    if seed is not None:
        command += ["--seed", str(seed)]
    return command + list(options)


def _reason(error: Exception) -> str:
    """Returns SUMO's words on one line; some of them it prints on stderr alone."""
    message = " ".join(str(error).split()).rstrip(".")
    if message in {"", "Process Error", "Connection closed by SUMO"}:
        return "its own message stands above"
    return message
