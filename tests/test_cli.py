"""The command line: exit codes, one clear message, multiruns that go on, and plain sub-commands."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import pytest
from hydra.core.hydra_config import HydraConfig

import cfx
from cfx.app import application, cli
from cfx.core import registry
from cfx.data.tidy import write_tidy
from cfx.errors import CfxError, ConfigError, DataError
from cfx.results.mlflow import serve
from cfx.results.mlflow.store import open_store
from tests.checkout import DISTRIBUTIONS, ROOT, needs
from tests.drives import straight_pairs

JOB = """
    import logging, os, signal, sys, time
    from dataclasses import dataclass
    from cfx.errors import DataError
    from cfx.evaluation.metrics.base import RMSE_SPEED

    log = logging.getLogger("cfx.jobs_stub")

    @dataclass
    class Result:
        metrics: dict
        folder: object
        config: object
        judge = RMSE_SPEED

    def run_job(config, folder):
        log.info("driving %s", config.model["name"])
        if config.seed == 1:
            raise DataError("pairs.csv, row 3: the gap is negative")
        if config.seed == 2:
            raise ZeroDivisionError("a bug")
        if config.seed == 3:
            raise KeyboardInterrupt
        if config.seed == 4:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(5)
        if config.seed == 5:
            try:
                raise KeyboardInterrupt
            except KeyboardInterrupt:
                sys.exit(1)
        (folder / "metrics.json").write_text(str(os.getpid()))
        return Result({"rmse_speed/policy": 0.5}, folder, config)
"""

Run = Callable[..., int]


@pytest.fixture
def run(install, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    """Returns the application with a job that does what its seed says, in an empty folder."""
    install("jobs-stub", {}, {"jobs_stub.py": JOB})
    monkeypatch.chdir(tmp_path)
    return lambda *arguments: application.start(
        arguments, run_job=import_module("jobs_stub").run_job
    )


def outputs(folder: Path) -> list[Path]:
    """Returns the job folders below, in order."""
    return sorted(path.parent for path in folder.rglob("metrics.json"))


def test_a_job_that_ends_well_exits_with_0_and_leaves_its_log(
    run: Run, tmp_path: Path, capsys
) -> None:
    assert run("model=w99") == 0
    (folder,) = outputs(tmp_path)
    assert folder.name.endswith("-w99-gru")
    assert "INFO cfx.jobs_stub: driving w99" in (folder / "cfx.log").read_text(encoding="utf-8")
    printed = capsys.readouterr()
    assert printed.out == "driving w99\n"
    assert printed.err == ""


def test_a_users_mistake_in_a_job_is_one_sentence_on_stderr_and_in_the_log(
    run: Run, tmp_path: Path, capsys
) -> None:
    assert run("seed=1") == 2
    assert capsys.readouterr().err == "pairs.csv, row 3: the gap is negative\n"
    (log,) = tmp_path.rglob("cfx.log")
    assert "pairs.csv, row 3: the gap is negative" in log.read_text(encoding="utf-8")


@pytest.mark.parametrize("how", ["hydra.verbose=true", "CFX_TRACEBACK", "HYDRA_FULL_ERROR"])
def test_the_whole_traceback_is_shown_on_request(
    run: Run, how: str, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    arguments = [how] if "=" in how else []
    if not arguments:
        monkeypatch.setenv(how, "1")
    assert run("seed=1", *arguments) == 2
    assert "Traceback" in capsys.readouterr().err
    assert os.environ.get("HYDRA_FULL_ERROR", "") == ("1" if how == "HYDRA_FULL_ERROR" else "")


def test_a_bug_shows_its_traceback_and_exits_with_1(run: Run, tmp_path: Path, capsys) -> None:
    assert run("seed=2") == 1
    printed = capsys.readouterr().err
    assert printed.count("Traceback") == 1
    assert "ZeroDivisionError: a bug" in printed
    (log,) = tmp_path.rglob("cfx.log")
    assert "ZeroDivisionError: a bug" in log.read_text(encoding="utf-8")


@pytest.mark.parametrize(("seed", "code"), [(3, 130), (5, 130), (4, 143)])
def test_ctrl_c_and_sigterm_have_their_exit_codes(run: Run, seed: int, code: int, capsys) -> None:
    before = signal.getsignal(signal.SIGTERM)
    assert run(f"seed={seed}") == code
    assert "Traceback" not in capsys.readouterr().err
    assert signal.getsignal(signal.SIGTERM) is before


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["modle=w99"],
            "modle=w99: there is no key 'modle'. Did you mean 'model'? Known keys: cache",
        ),
        (["model=kraus"], "model=kraus: there is no model 'kraus'. Did you mean 'krauss'? Known: "),
        (
            ["policy.hiden_size=3"],
            "'policy.hiden_size'. Did you mean 'policy.hidden_size'? Known keys of policy: ",
        ),
        (
            ["modl.parameters.v0.low=3"],
            "'modl.parameters.v0.low'. Did you mean 'model.parameters.v0.low'?",
        ),
        (
            ["data=tidy", "data.path=x.csv", "data.columns={pairid: trip}"],
            "'data.columns.pairid'. Did you mean 'data.columns.pair_id'? Known keys of",
        ),
        (
            ["model.parameters={A: 1}"],
            "there is no key 'model.parameters.A'. Did you mean 'model.parameters.a'?",
        ),
        (
            ["model.parameters={X: 1}"],
            "To replace all of them: '~model.parameters' '+model.parameters={X: 1}'",
        ),
        (["modle=w99", "policy=nope"], "policy=nope: there is no policy 'nope'."),
        (["seed=-1"], "seed=-1: should be greater than or equal to 0."),
        (["+sede=1"], "sede: unknown key. Did you mean 'seed'?"),
        (
            ["plugin"],
            "plugin: neither key=value nor a sub-command. Did you mean 'plugins'? Known: ",
        ),
        (["model=krauss,w99"], "model=krauss,w99: several values need a multirun; add -m"),
        (["seed=choice(1,2)"], "seed=choice(1,2): several values need a multirun; add -m"),
        (["seed=[1"], "seed=[1: cannot be read as key=value (no viable alternative at input '[1')"),
        (["experiment=3"], "choose an option by its name, such as model=w99"),
        (["seed=${nowhere}"], "Interpolation key 'nowhere' not found"),
        (["hydra.run.dir=outputs/${nowhere}"], "Interpolation key 'nowhere' not found"),
        (
            ["hydra/launcher=jobli"],
            "hydra/launcher=jobli: there is no hydra/launcher 'jobli'. Did you mean 'joblib'?",
        ),
        (["--config-name", "nope"], "Cannot find primary config 'nope'"),
        (["--config-dir", "nope"], "Additional config directory"),
        (["--cfg", "job", "--multirun"], "Only one of --run, --multirun, --cfg"),
        (["-m", "model=krauss,nope"], "model=nope: there is no model 'nope'."),
        (["--cfg", "job", "-p", "modl"], "package 'modl' not found in config"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_a_wrong_command_line_is_one_sentence_and_exit_code_2(
    run: Run, arguments: list[str], message: str, capsys
) -> None:
    assert run(*arguments) == 2
    printed = capsys.readouterr().err
    assert message in printed
    assert len(printed.splitlines()) == 1
    assert os.environ.get("HYDRA_FULL_ERROR") is None


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("model=3", "model=3: choose a model by its name, or leave it out; known: "),
        ("policy=null", "policy=null: choose a policy by its name, or leave it out; known: "),
        ("model=[idm,w99]", "a job has one model; several need a multirun (-m model=idm,w99)"),
        ("policy=cfx://idm", "is tested by protocol=transfer protocol.run=cfx://idm"),
        ("data=i-80/pairs.csv", "write the file as data.path=i-80/pairs.csv"),
    ],
)
def test_a_component_is_chosen_by_one_name(argument: str, message: str, capsys) -> None:
    assert cli.main([argument]) == 2
    printed = capsys.readouterr().err
    assert message in printed
    assert len(printed.splitlines()) == 1


def test_a_flag_that_does_not_exist_exits_with_2(run: Run, capsys) -> None:
    assert run("--mulitrun") == 2
    assert "usage: cfx" in capsys.readouterr().err


@pytest.mark.parametrize("key", ["hydra.run.dir", "hydra.sweep.dir"])
def test_an_output_folder_that_cannot_be_written_is_a_sentence(
    run: Run, tmp_path: Path, key: str, capsys
) -> None:
    (tmp_path / "file").write_text("here already")
    several = ["-m", "seed=7,8"] if key == "hydra.sweep.dir" else []
    assert run(*several, f"{key}={tmp_path}/file/below") == 2
    printed = capsys.readouterr().err
    assert f"{tmp_path}/file/below: Not a directory; choose an output folder" in printed
    assert "Traceback" not in printed


def test_a_users_yaml_that_is_no_yaml_is_named(run: Run, tmp_path: Path, capsys) -> None:
    (tmp_path / "mine" / "experiment").mkdir(parents=True)
    (tmp_path / "mine" / "experiment" / "broken.yaml").write_text("a: [1, 2\nb: 3\n")
    assert run("--config-dir", "mine", "experiment=broken") == 2
    printed = capsys.readouterr().err
    assert "broken.yaml" in printed
    assert "Traceback" not in printed


def test_a_multirun_goes_on_after_a_failed_job_and_tells_all_failures(
    run: Run, tmp_path: Path, capsys
) -> None:
    assert run("-m", "seed=0,1,2,7") == 1
    printed = capsys.readouterr()
    assert len(outputs(tmp_path)) == 2
    assert "2 of 4 jobs done" in printed.out
    assert "job 1 (seed=1) failed: pairs.csv, row 3: the gap is negative" in printed.err
    assert "job 2 (seed=2) failed: ZeroDivisionError: a bug" in printed.err
    summary = [line for line in printed.err.splitlines() if line.startswith("failed: ")]
    assert [line.partition(" (")[0] for line in summary] == [
        "failed: seed=1: pairs.csv, row 3: the gap is negative",
        "failed: seed=2: ZeroDivisionError: a bug",
    ]


def test_a_multirun_in_small_batches_goes_on_too_and_of_mistakes_alone_exits_with_2(
    run: Run, tmp_path: Path
) -> None:
    assert run("-m", "seed=1,0,7", "hydra.sweeper.max_batch_size=1") == 2
    assert len(outputs(tmp_path)) == 2


def test_outcomes_of_an_earlier_multirun_in_the_same_folder_do_not_count(
    run: Run, tmp_path: Path, capsys
) -> None:
    again = f"hydra.sweep.dir={tmp_path}/sweep"
    assert run("-m", "seed=0,1,1", again) == 2
    assert run("-m", "seed=0", again) == 0
    assert "1 of 1 jobs done" in capsys.readouterr().out


PLUGIN = """
    from cfx.plugin import Dataset

    class Mine(Dataset):
        def read(self):
            return None
"""


def test_a_multirun_in_worker_processes_composes_a_plugin_and_reports_failures(
    run: Run, install, tmp_path: Path
) -> None:
    install("mine-data", {"cfx.datasets": {"mine": "mine_data:Mine"}}, {"mine_data.py": PLUGIN})
    script = (
        "import sys; from cfx.app.application import start; from jobs_stub import run_job;"
        " sys.exit(start(sys.argv[1:], run_job=run_job))"
    )
    arguments = [
        "-m",
        "hydra/launcher=joblib",
        "hydra.launcher.n_jobs=2",
        "data=mine",
        "seed=0,1",
    ]
    environment = {
        **os.environ,
        "PYTHONPATH": str(install.folder),
    }  # joblib's workers outlive the call: a process of its own
    command = [sys.executable, "-c", script, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 2, done.stderr
    assert "1 of 2 jobs done" in done.stdout
    assert sum(line.startswith("failed: data=") for line in done.stderr.splitlines()) == 1
    assert len(outputs(tmp_path)) == 1
    assert all(
        int((folder / "metrics.json").read_text()) != os.getpid() for folder in outputs(tmp_path)
    )


def test_help_lists_groups_sub_commands_and_only_keys_that_exist(run: Run, capsys) -> None:
    assert run("--help") == 0
    printed = capsys.readouterr().out
    for command in registry.names("command"):
        assert f"cfx {command.replace('.', ' ')} " in printed
    lines = (line.partition(": ") for line in printed.splitlines())
    listed = {group: set(names.split(", ")) for group, _, names in lines}
    assert listed["model"] >= {"krauss", "helly", "w99"}  # and those of plugins
    assert listed["policy"] >= {"default", "fixed", "gru", "lstm"}
    overrides = (
        "style.cluster=aggressive",
        "model.parameters.T.high=12",
        "seed=1",
        "device=cuda",
        "split=0.7",
    )
    assert [one for one in overrides if one not in printed] == []
    assert run("--cfg", "job", *overrides) == 0


@pytest.mark.parametrize("command", registry.names("command"))
def test_a_sub_command_is_the_advice_for_a_slip(run: Run, command: str, capsys) -> None:
    slip = command + command[-1]
    assert run(slip) == 2
    assert f"Did you mean '{command}'?" in capsys.readouterr().err


def named_commands() -> list[tuple[str, str]]:
    """Returns the commands of cfx that the package, its configuration and its templates name."""
    found = []
    for folder, pattern in (("cfx", "*.py"), ("cfx", "*.jinja"), ("conf", "*.yaml")):
        for path in sorted((ROOT / folder).rglob(pattern)):
            text = path.read_text(encoding="utf-8")
            for words in re.findall(r"(?:python -m cfx|`cfx) +([^`\"\n{]+)", text):
                found.append((str(path.relative_to(ROOT)), words))
    return found


@needs(*DISTRIBUTIONS)
def test_every_command_that_a_text_names_exists() -> None:
    commands = named_commands()
    assert len(commands) > 30
    for where, words in commands:
        first, *further = words.split()
        is_override = "=" in first or first.isupper() or first.startswith("-")
        assert is_override or first in registry.names("command"), f"{where} names cfx {words}"
        if first in {"plugins", "data"} and further and further[0].isalpha():
            assert further[0] in {"check", "show", "new", "describe", "fetch", "flows"}, (
                f"{where}: {words}"
            )


@pytest.mark.parametrize(
    "arguments",
    [["--cfg", "job"], ["--info", "searchpath"], ["--info", "defaults"], ["--hydra-help"]],
    ids=" ".join,
)
def test_hydras_own_flags_work(run: Run, arguments: list[str], capsys) -> None:
    assert run(*arguments) == 0
    assert capsys.readouterr().out


def test_tab_completion_knows_plugins(
    run: Run, install, capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    install("mine-data", {"cfx.datasets": {"mine": "mine_data:Mine"}}, {"mine_data.py": PLUGIN})
    monkeypatch.setenv("COMP_LINE", "cfx data=")
    monkeypatch.setenv("COMP_POINT", "9")
    assert run("-sc", "query=bash") == 0
    assert "data=mine" in capsys.readouterr().out.split()


def test_the_process_is_left_as_it_was(run: Run) -> None:
    import logging

    before = sys.argv, list(logging.getLogger().handlers), Path.cwd()
    assert run() == 0
    assert (sys.argv, list(logging.getLogger().handlers), Path.cwd()) == before


def test_cfx_run_runs_the_same_job_into_a_fresh_folder(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        HydraConfig.instance(), "cfg", None
    )  # as in a process where Hydra never ran
    first = application.run(["model=w99", "seed=7"], run_job=import_module("jobs_stub").run_job)
    again = application.run(
        ["model=w99", f"hydra.run.dir={first.folder}"], run_job=import_module("jobs_stub").run_job
    )
    assert first.config.model["name"] == "w99"  # type: ignore[attr-defined]  # the stub's result
    assert first.folder.is_relative_to(tmp_path)
    assert again.folder == first.folder.with_name(f"{first.folder.name}-2")
    assert "driving w99" in (first.folder / "cfx.log").read_text(encoding="utf-8")
    assert run("seed=7") == 0  # Hydra is free again


@pytest.mark.parametrize(
    ("overrides", "error", "message"),
    [
        (["modle=w99"], ConfigError, "Did you mean 'model'"),
        (["model=kraus"], ConfigError, "Did you mean 'krauss'"),
        (["seed=-1"], ConfigError, "seed=-1"),
        (["seed=1"], DataError, "row 3"),
        (["hydra.run.dir=file/below"], ConfigError, "choose an output folder"),
        ("model=w99 policy=gru", ConfigError, r"cfx\.run\(\['model=w99', 'policy=gru'\]\)"),
    ],
)
def test_cfx_run_raises_what_the_command_line_would_print(
    run: Run, tmp_path: Path, overrides: list[str], error: type[CfxError], message: str
) -> None:
    (tmp_path / "file").write_text("here already")
    with pytest.raises(error, match=message):
        application.run(overrides, run_job=import_module("jobs_stub").run_job)
    assert cfx.run is application.run


def test_main_takes_its_arguments_from_the_command_line(
    monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    monkeypatch.setattr(sys, "argv", ["cfx", "plugins"])
    assert cli.main() == 0
    assert "krauss" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["plugins", "show", "model", "w98"], "Did you mean 'w99'"),
        (["plugins", "show", "mdl", "w99"], "Did you mean 'model'"),
        (["data", "describe", "nowhere.csv"], "nowhere.csv"),
        (["calibrate", "."], "is a folder that no dataset reads as a whole; name the files in it"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_a_sub_commands_mistake_is_one_sentence_and_exit_code_2(
    arguments: list[str], message: str, capsys
) -> None:
    assert cli.main(arguments) == 2
    printed = capsys.readouterr().err
    assert message in printed
    assert len(printed.splitlines()) == 1


def test_data_describe_takes_several_files(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = [str(tmp_path / f"{name}.csv") for name in "ab"]
    for file, frames in zip(files, (50, 60), strict=True):
        write_tidy(straight_pairs([frames]), file)
    assert cli.main(["data", "describe", *files]) == 0
    said = capsys.readouterr().out
    assert said.index("data.path=" + files[0]) < said.index("data.path=" + files[1])


def test_data_describe_prints_what_a_recording_holds(shared_data: Path, capsys) -> None:
    assert cli.main(["data", "describe", str(shared_data / "i80_reconstructed_pairs.parquet")]) == 0
    assert "pairs" in capsys.readouterr().out


def test_ui_starts_mlflow_on_this_machine_only_and_prints_links(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    started: list[tuple[list[str], dict[str, str]]] = []
    monkeypatch.setattr(
        os, "execve", lambda path, command, environment: started.append((command, environment))
    )
    monkeypatch.setattr(serve, "_links", lambda store, port: [f"links for {store}"])
    store = f"sqlite:///{tmp_path}/mlflow.db"
    open_store(store, "cfx")
    assert cli.main(["ui", "--uri", store, "--port", "5793"]) == 0
    ((command, environment),) = started
    assert command[1:] == [
        "-m",
        "mlflow",
        "ui",
        "--host",
        "127.0.0.1",
        "--port",
        "5793",
        "--workers",
        "1",
        "--backend-store-uri",
        store,
    ]
    assert environment["MLFLOW_DISABLE_TELEMETRY"] == "true"
    assert f"links for {store}" in capsys.readouterr().out


def test_ui_without_any_tracked_job_or_with_a_taken_port_says_so(tmp_path: Path, capsys) -> None:
    import socket

    assert cli.main(["ui", "--uri", f"sqlite:///{tmp_path}/none.db"]) == 2
    assert "no job has been tracked" in capsys.readouterr().err
    open_store(f"sqlite:///{tmp_path}/mlflow.db", "cfx")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert (
            cli.main(["ui", "--uri", f"sqlite:///{tmp_path}/mlflow.db", "--port", str(port)]) == 2
        )
    assert f"--port {port} cannot be used" in capsys.readouterr().err


def test_ui_on_a_foreign_file_says_so(tmp_path: Path, capsys) -> None:
    (tmp_path / "notes.db").write_text(
        "not a database, but some text that is long enough to look like a file"
    )
    assert cli.main(["ui", "--uri", f"sqlite:///{tmp_path}/notes.db"]) == 2
    assert "notes.db" in capsys.readouterr().err


def test_ui_on_a_server_says_where_it_is(capsys) -> None:
    assert cli.main(["ui", "--uri", "http://127.0.0.1:5999"]) == 0
    assert "http://127.0.0.1:5999" in capsys.readouterr().out


@pytest.mark.parametrize(("name", "code"), [("SIGINT", 130), ("SIGTERM", 143)])
@pytest.mark.parametrize("delay", [0.12, 0.25])
def test_a_signal_that_comes_early_has_its_exit_code(
    name: str, code: int, delay: float, tmp_path: Path
) -> None:
    """Before the application is there; a machine that is slower is hit even earlier."""
    ready = tmp_path / "ready"
    script = (
        "import pathlib, signal, sys; from cfx.app.cli import program;"
        # Who starts the tests in the background makes their processes deaf to Ctrl-C.
        " signal.signal(signal.SIGINT, signal.default_int_handler);"
        f" pathlib.Path({str(ready)!r}).touch();"
        " sys.argv = ['cfx', 'debug=quick', 'hydra.run.dir=' + sys.argv[1]]; program()"
    )
    started = subprocess.Popen(
        [sys.executable, "-c", script, str(tmp_path / "job")],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    while not ready.exists():
        time.sleep(0.005)
    time.sleep(delay)
    started.send_signal(getattr(signal, name))
    _, err = started.communicate(timeout=60)
    assert started.returncode == code
    assert b"Traceback" not in err
