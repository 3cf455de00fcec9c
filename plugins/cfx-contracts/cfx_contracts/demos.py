"""The contract of a demonstration, statement by statement.

It shows a small job: two simulated drivers and a policy with constant parameters.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from functools import cache
from pathlib import Path

from cfx.core.contract import NotApplicable
from cfx.data.pairs import PairSet
from cfx.errors import CfxError, NotInstalledError
from cfx.evaluation.demo import Demo
from cfx.evaluation.protocols.base import ProtocolResult
from cfx.evaluation.protocols.within_driver import WithinDriver
from cfx.policies import checkpoint
from cfx.policies.constant import FixedPolicy
from cfx.simulation.synthetic import SyntheticDataset
from cfx_contracts import contract_of
from cfx_contracts.protocols import context


def check_refuses_in_one_sentence(demo: Demo) -> None:
    pairs, _ = _job()
    said = ""
    try:
        demo.check(pairs)
    except NotInstalledError:
        raise
    except CfxError as error:
        said = str(error)
    assert len(said.splitlines()) <= 1, (
        f"`check` says in one sentence why it cannot show a job, not: {said}"
    )


def write_returns_the_files_in_its_folder(demo: Demo) -> None:
    pairs, result = _job()
    try:
        demo.check(pairs)
    except NotInstalledError:
        raise
    except CfxError as error:
        raise NotApplicable(f"it cannot show the job of this contract: {error}") from error
    with tempfile.TemporaryDirectory(prefix="cfx-demo-") as job:
        checkpoint.save_agent(result.policy, Path(job, "policy"))
        folder = Path(job, "demo")
        folder.mkdir()
        protocol = {"name": "within_driver"}
        paths = demo.write(folder, pairs, result.policy, result.evaluation, protocol)
        written = set()
        for path in folder.rglob("*"):
            if path.is_file():
                written.add(path)
        assert set(paths) == written, (
            "`write` returns the files that it has written, which MLflow then keeps:"
            f" {sorted(path.name for path in written.symmetric_difference(paths))}"
        )
        beside = {path.name for path in Path(job).iterdir()} - {"policy", "demo"}
        assert not beside, f"`write` writes into its own folder alone, not {sorted(beside)}"


@cache
def _job() -> tuple[PairSet, ProtocolResult]:
    """Returns the trajectories and the result of a job that calibrates two drivers."""
    pairs = SyntheticDataset(pairs=2, platoon_size=1, frames=300).load()
    given = replace(context(pairs, policy=FixedPolicy()), policy_node={"name": "fixed"})
    return pairs, WithinDriver().run(given)


CONTRACT = contract_of(__name__, "demo", slow=[write_returns_the_files_in_its_folder])
