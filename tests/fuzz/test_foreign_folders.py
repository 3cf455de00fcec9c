"""Somebody else's job folder is data: nothing in it runs, nothing outside it is read or written."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

import cfx
from cfx.app import cli
from cfx.errors import CfxError
from cfx.evaluation.protocols.transfer import Transfer, TransferSettings
from cfx.policies import checkpoint
from tests.broken_plugins import QUICK
from tests.fuzz.test_fuzz import EXAMPLES, JUNK, damaged, fuzz, leaves, put, said

pytest.importorskip("cfx_report", reason="the report reads folders too")
pytest.importorskip("cfx_sumo", reason="the export reads folders too")

from cfx_report import inline
from cfx_report.page import render
from cfx_report.runs import read_runs
from cfx_sumo.export import export
from cfx_sumo.live.driver import Driver

JOB = [one for one in QUICK if not one.startswith(("policy", "protocol", "learner", "data.pairs"))]
JOB += ["policy=gru", "learner=imitation", "learner.epochs=1", "policy.hidden_size=4"]
JOB += ["data.pairs=4", "protocol=across_drivers", "protocol.folds=2"]

PAYLOAD = {"_target_": "os.mkdir", "_args_": ["ran"]}
WORDS = "the words of another file"
SCRIPT = "</script><script>alert('ran')</script>"


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("foreign") / "job"
    assert cli.main([*JOB, f"hydra.run.dir={folder}"]) == 0
    return folder


@pytest.fixture
def folder(finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Somebody else's folder, beside what is not theirs."""
    monkeypatch.chdir(tmp_path)
    copy = tmp_path / "job"
    shutil.copytree(finished, copy)
    (tmp_path / "secret.json").write_text(json.dumps({"words": WORDS}))
    return copy


def load(folder: Path) -> Any:
    return cfx.load(folder)


def load_policy(folder: Path) -> Any:
    return checkpoint.load_agent(folder / "policy")


def report(folder: Path) -> str:
    return render(read_runs([str(folder)]))


def report_without_drawings(folder: Path) -> str:
    """Draws the figures, and does not print them, which takes most of the time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(inline, "inline_svg", lambda _: '<svg viewBox="0 0 1 1"></svg>')
        return report(folder)


def write_export(folder: Path) -> Any:
    return export(folder, folder.parent / "exported" / "drivers.add.xml")


def transfer(folder: Path) -> Any:
    return Transfer(TransferSettings(run=folder)).finished.agent


def drive(folder: Path) -> Any:
    return Driver.load(folder)


READERS: tuple[Callable[[Path], Any], ...] = (
    load,
    load_policy,
    report_without_drawings,
    write_export,
    transfer,
    drive,
)


def read_all(folder: Path, readers: Iterable[Callable[[Path], Any]] = READERS) -> list[str]:
    """Reads a folder in every way; returns the sentences that refuse it."""
    sentences = []
    for read in readers:
        try:
            read(folder)
        except CfxError as error:
            said(error)
            sentences.append(str(error))
    return sentences


def nothing_happened(folder: Path) -> None:
    """Checks that nothing ran, and nothing beside the folder was changed."""
    beside = {path.name for path in folder.parent.iterdir()}
    assert beside <= {"job", "secret.json", "exported"}
    assert json.loads((folder.parent / "secret.json").read_text()) == {"words": WORDS}


def test_an_honest_folder_is_read_in_every_way(folder: Path) -> None:
    readers = [report if read is report_without_drawings else read for read in READERS]
    assert read_all(folder, readers) == []
    nothing_happened(folder)


@settings(fuzz, max_examples=max(8, EXAMPLES // 5))
@given(data=st.data())
def test_any_file_of_a_folder(data: st.DataObject, finished: Path, tmp_path: Path) -> None:
    folder = tmp_path / "job"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(finished, folder)
    names = sorted(str(one.relative_to(folder)) for one in folder.rglob("*") if one.is_file())
    path = folder / data.draw(st.sampled_from(names))
    if path.suffix in {".json", ".yaml"} and data.draw(st.booleans()):
        text = path.read_text()
        values = json.loads(text) if path.suffix == ".json" else yaml.safe_load(text)
        values = put(values, data.draw(st.sampled_from(leaves(values) or [()])), data.draw(JUNK))
        path.write_text(json.dumps(values) if path.suffix == ".json" else yaml.safe_dump(values))
    elif path.suffix in {".csv", ".parquet"} and data.draw(st.booleans()):
        table = pd.read_csv(path) if path.suffix == ".csv" else pd.read_parquet(path)
        column = data.draw(st.sampled_from(sorted(map(str, table.columns))))
        if data.draw(st.booleans()):
            table = table.drop(columns=column)
        else:
            cells = st.text(max_size=8) | st.floats() | st.integers(-(2**63), 2**63 - 1)
            table[column] = data.draw(cells)
        with contextlib.suppress(UnicodeEncodeError):
            table.to_csv(path, index=False) if path.suffix == ".csv" else table.to_parquet(path)
    elif path.stat().st_size:
        path.write_bytes(damaged(path.read_bytes(), data))
    read_all(folder, READERS if EXAMPLES < 1000 else (*READERS, report))


@pytest.mark.parametrize("name", ["metrics.json", "pairs.csv", "config.yaml", "policy/policy.json"])
def test_a_link_that_leads_out_is_not_followed(name: str, folder: Path) -> None:
    path = folder / name
    path.unlink()
    path.symlink_to(folder.parent / "secret.json")
    sentences = read_all(folder)
    assert sentences
    for sentence in sentences:
        assert WORDS not in sentence
        assert "is a link that leads out of its folder, and is not followed" in sentence
    nothing_happened(folder)


def test_a_linked_folder_and_an_absolute_link_are_not_followed(folder: Path) -> None:
    elsewhere = folder.parent.parent / f"{folder.parent.name}-elsewhere"
    shutil.move(folder / "policy", elsewhere)
    (folder / "policy").symlink_to(elsewhere)
    with pytest.raises(CfxError, match="leads out of its folder"):
        cfx.load(folder)
    with pytest.raises(CfxError, match="leads out of its folder"):
        report(folder)


def test_the_folder_itself_may_be_a_link(folder: Path) -> None:
    link = folder.with_name("exported")
    link.symlink_to(folder)
    assert cfx.load(link).metrics == cfx.load(folder).metrics


def test_a_loop_of_links_is_one_sentence(folder: Path) -> None:
    (folder / "loop").symlink_to("loop")
    with pytest.raises(CfxError, match="leads nowhere"):
        cfx.load(folder)


def test_a_pipe_is_not_waited_for(folder: Path) -> None:
    (folder / "metrics.json").unlink()
    os.mkfifo(folder / "metrics.json")
    for sentence in read_all(folder):
        assert "no file" in sentence or "no finished job" in sentence


def test_a_huge_file_is_not_read(folder: Path) -> None:
    for name in ("policy/policy.safetensors", "cfx.log"):
        with (folder / name).open("r+b") as file:
            file.truncate(2**40)  # sparse: it takes no room
    sentences = read_all(folder)
    assert len(sentences) == len(READERS)
    for sentence in sentences:
        assert "at most 256 are read" in sentence


def test_a_short_text_that_means_a_huge_one_is_refused(folder: Path) -> None:
    lines = ["model: &a0 [x, x]"]
    for number in range(60):
        lines.append(f"k{number}: &a{number + 1} [*a{number}, *a{number}]")
    (folder / "config.yaml").write_text("\n".join(lines))
    for read in (report, write_export):
        with pytest.raises(CfxError, match="alias"):
            read(folder)


@pytest.mark.parametrize("depth", [100, 100_000])
def test_a_deeply_nested_text_is_refused(depth: int, folder: Path) -> None:
    text = "[" * depth + "]" * depth
    for name, reads in (
        ("data.json", (report,)),
        ("policy/policy.json", (load, transfer, drive)),
        ("metrics.json", (load, report)),
        ("config.yaml", (report, write_export)),
    ):
        if depth > 1000 and name == "config.yaml":
            continue  # PyYAML takes minutes for it; it is no way to harm anybody but oneself
        before = (folder / name).read_text()
        (folder / name).write_text(f'{{"metrics": {text}}}')
        for read in reads:
            with pytest.raises(CfxError, match="nested"):
                read(folder)
        (folder / name).write_text(before)


@pytest.mark.parametrize("place", ["config.yaml", "policy/policy.json", "data.json"])
def test_a_target_is_plain_text(place: str, folder: Path) -> None:
    path = folder / place
    values = yaml.safe_load(path.read_text())
    values.update(PAYLOAD)
    values["more"] = PAYLOAD
    for key in ("model", "policy"):
        if isinstance(values.get(key), dict):
            values[key] = {**values[key], **PAYLOAD}
    path.write_text(json.dumps(values))
    read_all(folder)
    nothing_happened(folder)


def test_a_tag_of_yaml_makes_no_object(folder: Path) -> None:
    config = folder / "config.yaml"
    config.write_text(config.read_text() + "more: !!python/object/apply:os.mkdir [ran]\n")
    sentences = read_all(folder)
    assert any("config.yaml" in sentence for sentence in sentences)
    nothing_happened(folder)


def test_an_interpolation_is_plain_text(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CFX_SECRET", WORDS)
    config = folder / "config.yaml"
    values = yaml.safe_load(config.read_text())
    values["model"]["name"] = "${oc.env:CFX_SECRET}"
    values["data"]["name"] = "${oc.env:CFX_SECRET}"
    config.write_text(yaml.safe_dump(values))
    text = report_without_drawings(folder)
    assert "${oc.env:CFX_SECRET}" in text
    assert WORDS not in text
    for sentence in read_all(folder):
        assert WORDS not in sentence


@pytest.mark.parametrize(
    "name",
    ["os.mkdir", "os:mkdir", "../../secret", "/etc/passwd", "cfx.models.krauss:Krauss", "__main__"],
)
@pytest.mark.parametrize("kind", ["model", "policy"])
def test_a_name_imports_nothing(kind: str, name: str, folder: Path) -> None:
    path = folder / "policy" / "policy.json"
    values = json.loads(path.read_text())
    values[kind] = {"name": name}
    path.write_text(json.dumps(values))
    for read in (load, transfer, drive):
        with pytest.raises(CfxError, match=r"is installed|There is no|there is no|no .* named"):
            read(folder)
    nothing_happened(folder)


def test_words_of_a_folder_are_no_part_of_the_page(folder: Path) -> None:
    table = pd.read_csv(folder / "pairs.csv")
    table["pair_id"] = SCRIPT
    table["driver"] = SCRIPT
    table.to_csv(folder / "pairs.csv", index=False)
    config = folder / "config.yaml"
    values = yaml.safe_load(config.read_text())
    values["experiment_name"] = SCRIPT
    values["model"]["name"] = SCRIPT
    config.write_text(yaml.safe_dump(values))
    assert "<script>alert" not in report(folder)


def test_a_table_that_fits_no_memory_is_refused(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    one = pa.table({"pair_id": pa.array(["a"] * 2**20).dictionary_encode()})
    with pq.ParquetWriter(folder / "trajectories.parquet", one.schema) as writer:
        for _ in range(40):
            writer.write_table(one)
    assert (folder / "trajectories.parquet").stat().st_size < 2**20
    monkeypatch.setattr("cfx.results.table.total_memory", lambda: 2.0**28)
    with pytest.raises(CfxError, match=r"holds a table of 336 MB, more than this machine's memory"):
        report(folder)


@pytest.mark.filterwarnings("ignore:.*Any type hint")
def test_mlflow_serves_a_policy_only_from_its_weights(folder: Path) -> None:
    from cfx.results.mlflow.served_policy import ServedPolicy

    class Context:
        artifacts = {"policy": str(folder / "policy")}  # noqa: RUF012 - MLflow's has it so

    context: Any = Context()
    served = ServedPolicy()
    served.load_context(context)
    weights = folder / "policy" / "policy.safetensors"
    weights.write_bytes(weights.read_bytes()[:-7])
    with pytest.raises(CfxError, match="no policy that can be read"):
        served.load_context(context)
