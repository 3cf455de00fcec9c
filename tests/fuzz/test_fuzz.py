"""Nothing that anybody sends ends in a traceback: a sentence, or a result.

`make fuzz` tries more (`CFX_FUZZ_EXAMPLES`, 5,000 for each statement); the suite takes a few of each.
"""

from __future__ import annotations

import copy
import json
import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cfx.app.hydra_source import composed, plain
from cfx.app.user_errors import explain, is_user_error
from cfx.calibration.cache import Cache
from cfx.core import registry
from cfx.data.describe import describe
from cfx.data.tidy import write_tidy
from cfx.errors import CfxError
from cfx.policies import checkpoint
from cfx.results.config import JobConfig
from cfx.results.mlflow.tracker import MlflowTracker
from tests.agents import adaptive
from tests.drives import straight_pairs

EXAMPLES = int(os.environ.get("CFX_FUZZ_EXAMPLES", "40"))

fuzz = settings(
    max_examples=EXAMPLES,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)

JUNK = (
    st.none()
    | st.booleans()
    | st.integers(-(2**70), 2**70)
    | st.floats()
    | st.text(max_size=12)
    | st.sampled_from(["", "???", "${oc.env:HOME}", "../..", "\x1b[2J", "nan", "1e999", "null"])
    | st.lists(st.integers(), max_size=3)
    | st.dictionaries(st.text(max_size=4), st.integers(), max_size=2)
)
"""Values of every kind."""


def leaves(values: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Returns the paths of all values in nested dictionaries and lists."""
    items: Any = ()
    if isinstance(values, dict):
        items = values.items()
    elif isinstance(values, list):
        items = enumerate(values)
    found = [path] if path else []
    for key, value in items:
        found += leaves(value, (*path, key))
    return found


def put(values: Any, path: tuple[Any, ...], new: Any) -> Any:
    """Returns a copy with another value at a path."""
    changed = copy.deepcopy(values)
    at = changed
    for key in path[:-1]:
        at = at[key]
    at[path[-1]] = new
    return changed


def said(error: CfxError) -> None:
    """Checks what a user would read: at most a screenful."""
    lines = str(error).splitlines()
    assert 0 < len(lines) < 40


CONFIG = plain(composed([]))
PATHS = leaves(CONFIG)


@fuzz
@given(path=st.sampled_from(PATHS), value=JUNK)
def test_any_value_at_any_key_of_a_configuration(path: tuple[Any, ...], value: Any) -> None:
    try:
        config = JobConfig.of(put(CONFIG, path, value))
        for kind in registry.KINDS:
            node = getattr(config, registry.kind_of(kind).group, None)
            if isinstance(node, dict) and kind not in {"metric"}:
                registry.create(kind, node)
    except CfxError as error:
        said(error)


@fuzz
@given(
    key=st.sampled_from([".".join(map(str, path)) for path in PATHS]) | st.text(max_size=10),
    value=st.text(max_size=15),
)
def test_any_override_on_the_command_line(key: str, value: str) -> None:
    override = f"{key}={value}"
    try:
        composed([override])
    except Exception as error:
        if not is_user_error(error):
            raise
        said(CfxError(explain(error, [override])))


def table() -> pd.DataFrame:
    """Returns two pairs in the tidy layout."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "pairs.csv"
        write_tidy(straight_pairs([12, 15]), file)
        return pd.read_csv(file)


TABLE = table()


READERS = [
    registry.get("dataset", name) for name in registry.names("dataset") if name in {"tidy", "ngsim"}
]
"""The reader of cfx, and one of a plugin where that is installed."""


def examined(path: Path) -> None:
    """Loads and describes a file; only sentences may come of it."""
    for read in READERS:
        try:
            read(path=path, min_duration=0).load()
        except CfxError as error:
            said(error)
    try:
        assert describe(path).text
    except CfxError as error:
        said(error)


@fuzz
@given(
    column=st.sampled_from(list(TABLE.columns)),
    row=st.integers(0, len(TABLE) - 1),
    value=JUNK,
    form=st.sampled_from(["csv", "parquet"]),
)
def test_any_cell_of_a_recording(
    column: str, row: int, value: Any, form: str, tmp_path: Path
) -> None:
    cells = TABLE[column].astype(object).tolist()
    cells[row] = value
    changed = TABLE.assign(**{column: cells})
    path = tmp_path / f"pairs.{form}"
    if form == "csv":
        changed.to_csv(path, index=False, errors="surrogatepass")
    else:
        try:
            changed.to_parquet(path)
        except Exception:
            changed.astype({column: str}).to_parquet(path)
    examined(path)


@fuzz
@given(data=st.data())
def test_any_bytes_of_a_recording(data: st.DataObject, tmp_path: Path) -> None:
    path = tmp_path / data.draw(st.sampled_from(["a.csv", "a.parquet", "a.csv.gz", "a.txt"]))
    if path.name == "a.parquet":
        TABLE.to_parquet(path)
    else:
        TABLE.to_csv(path, index=False)
    path.write_bytes(damaged(path.read_bytes(), data))
    examined(path)


def damaged(content: bytes, data: st.DataObject) -> bytes:
    """Returns bytes that were cut, filled up, or changed in a few places."""
    how = data.draw(st.sampled_from(["cut", "flip", "fill", "junk"]))
    if how == "cut":
        return content[: data.draw(st.integers(0, len(content)))]
    if how == "junk":
        return data.draw(st.binary(max_size=200))
    if how == "fill":
        at = data.draw(st.integers(0, len(content)))
        return content[:at] + data.draw(st.binary(max_size=40)) + content[at:]
    changed = bytearray(content)
    for _ in range(data.draw(st.integers(1, 8))):
        changed[data.draw(st.integers(0, len(changed) - 1))] ^= data.draw(st.integers(1, 255))
    return bytes(changed)


@fuzz
@given(data=st.data())
def test_any_saved_policy(data: st.DataObject, tmp_path: Path) -> None:
    checkpoint.save_agent(adaptive({"name": "krauss"}, offsets=True), tmp_path)
    description = tmp_path / "policy.json"
    if data.draw(st.booleans()):
        values = json.loads(description.read_text())
        changed = put(values, data.draw(st.sampled_from(leaves(values))), data.draw(JUNK))
        description.write_text(json.dumps(changed))
    else:
        name = data.draw(st.sampled_from(["policy.json", "policy.safetensors"]))
        path = tmp_path / name
        path.write_bytes(damaged(path.read_bytes(), data))
    try:
        agent = checkpoint.load_agent(tmp_path)
        agent.begin(torch.zeros(1, dtype=torch.int64))
    except CfxError as error:
        said(error)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An MLflow store with a run of a sweep."""
    file = tmp_path_factory.mktemp("store") / "mlflow.db"
    tags = {"cfx.folder": str(file.parent)}
    names = {"run_name": "one", "parameters": {"seed": "0"}, "tags": tags, "sweep": "s"}
    with MlflowTracker.run(f"sqlite:///{file}", **names) as run:
        run.log_metrics({"loss": 0.5})
    return file


@settings(fuzz, max_examples=max(10, EXAMPLES // 20))
@given(data=st.data())
def test_any_mlflow_store(data: st.DataObject, store: Path, tmp_path: Path) -> None:
    file = tmp_path / "mlflow.db"
    file.unlink(missing_ok=True)
    content = bytearray(store.read_bytes())
    if data.draw(st.booleans()):
        # SQLite keeps what a table is in the first pages, and much of the others is empty.
        page = 4096 * data.draw(st.integers(0, len(content) // 4096 - 1))
        content[page : page + 4096] = damaged(bytes(content[page : page + 4096]), data)
    else:
        content = bytearray(damaged(bytes(content), data))
    file.write_bytes(bytes(content))
    try:
        names = {"run_name": "two", "parameters": {"seed": "1"}, "sweep": "s"}
        with MlflowTracker.run(f"sqlite:///{file}", **names) as run:
            run.log_metrics({"loss": 0.5})
    except CfxError as error:
        said(error)


@fuzz
@given(data=st.data())
def test_any_cache_entry(data: st.DataObject, tmp_path: Path) -> None:
    cache = Cache(tmp_path)
    cache.put("ab" * 32, {"loss": np.arange(5.0), "parameters": np.ones((3, 2))})
    (path,) = tmp_path.rglob("*.entry")
    before = path.read_bytes()
    path.write_bytes(damaged(before, data))
    found = cache.get("ab" * 32)
    if found is not None:
        assert path.read_bytes() == before
