"""Processes that need the same calibration share its work; each problem is solved once."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from cfx.calibration.cache import Cache
from cfx.core.component import content_key
from cfx.errors import OutputError
from tests.forks import Fork, Forks

PAIRS, GROUP = 24, 4

WORKER = f"""
import os, sys, time
from pathlib import Path
import torch
from cfx.calibration import calibrator as module
from cfx.calibration.cache import Cache
from cfx.calibration.shards import Solver
from cfx.models.krauss import Krauss
from cfx.calibration.random_search import RandomSearch
from cfx.data.pairs import PairBatch
from cfx.core.progress import Task
from cfx.simulation.rollout import MemoryStepper
from tests.drives import wavy_pairs

here, seconds = Path(sys.argv[1]), float(sys.argv[2])
module._CLAIM = {GROUP}

class Logged(RandomSearch):
    def solve(self, objective, guesses, *, seed):
        with (here / "log").open("a") as file:
            file.write(f"{{os.getpid()}} {{len(guesses)}}\\n")
        time.sleep(seconds)
        return super().solve(objective, guesses, seed=seed)

class Advanced(Task):
    def __exit__(self, *error):
        super().__exit__(*error)
        assert error[0] is not None or self.done == self.total, (self.done, self.total)

truth = torch.linspace(1, 3, {PAIRS}, dtype=torch.float64)[:, None].repeat(1, 2) * 0.4
pairs = wavy_pairs(Krauss(), truth)
tool = module.Calibrator(
    Solver(MemoryStepper(Krauss(), 0.1), Logged(samples=16), seed=0),
    cache=Cache(here / "cache"), progress=Advanced
)
(here / f"ready-{{os.getpid()}}").touch()
while not (here / "go").exists():
    time.sleep(0.01)
fixed = tool.driver_specific(pairs, PairBatch.of(pairs), torch.full((len(pairs),), 200))
print(fixed.tolist())
"""


@pytest.fixture(scope="module")
def forks(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Forks]:
    imports = "import cfx.calibration.calibrator, cfx.calibration.random_search, tests.drives"
    with Forks(imports, tmp_path_factory.mktemp("workers")) as started:
        yield started


@pytest.fixture
def start(forks: Forks, tmp_path: Path) -> Callable[[float], Fork]:
    """Returns a function that starts a worker, whose optimizer waits for so many seconds."""
    script = tmp_path / "worker.py"  # a file: the key of an entry holds the optimizer's source
    script.write_text(WORKER)
    return lambda seconds: forks.start([str(script), str(tmp_path), str(seconds)], tmp_path)


def release(here: Path, *workers: Fork) -> None:
    """Lets the workers begin together."""
    until(lambda: len(list(here.glob("ready-*"))) == len(workers), *workers)
    (here / "go").touch()


def until(what: Callable[[], bool], *workers: Fork) -> None:
    """Waits for something while the workers live."""
    while not what():
        for worker in workers:
            assert worker.poll() is None, worker.error.read_text()
        time.sleep(0.01)


def solved(here: Path) -> dict[int, int]:
    """Returns problems solved, by process."""
    counts: dict[int, int] = {}
    path = here / "log"
    for line in path.read_text().splitlines() if path.exists() else []:
        process, problems = map(int, line.split())
        counts[process] = counts.get(process, 0) + problems
    return counts


def test_two_processes_share_one_calibration_and_solve_each_problem_once(
    tmp_path: Path, start: Callable[[float], Fork]
) -> None:
    workers = [start(0.2) for _ in range(2)]
    release(tmp_path, *workers)
    codes = [worker.wait() for worker in workers]
    assert codes == [0, 0], [worker.error.read_text() for worker in workers]
    outputs = [worker.out.read_text() for worker in workers]
    counts = solved(tmp_path)
    assert sum(counts.values()) == PAIRS
    assert set(counts) == {worker.pid for worker in workers}  # neither only waited
    assert outputs[0] == outputs[1]
    assert len(json.loads(outputs[0])) == PAIRS
    assert len(list((tmp_path / "cache").rglob("*.entry"))) == PAIRS


def test_a_process_that_is_killed_with_its_claims_blocks_nobody(
    tmp_path: Path, start: Callable[[float], Fork]
) -> None:
    stuck = start(600)
    release(tmp_path, stuck)
    until(lambda: bool(solved(tmp_path)), stuck)
    other = start(0)
    # All but what the first has claimed, and problems whose claims lie in the same lock files.
    until(lambda: sum(solved(tmp_path).values()) > PAIRS - GROUP, stuck, other)
    assert other.poll() is None  # it waits for the claimed ones, and does not compute them again
    stuck.kill()
    assert stuck.wait() == -signal.SIGKILL
    assert other.wait() == 0, other.error.read_text()
    assert len(json.loads(other.out.read_text())) == PAIRS
    counts = solved(tmp_path)
    assert counts[other.pid] == PAIRS
    assert counts[stuck.pid] <= GROUP


def keys(count: int) -> list[str]:
    return [content_key({"number": number}) for number in range(count)]


def test_what_is_claimed_is_left_to_its_owner_until_it_lets_go(tmp_path: Path) -> None:
    mine, theirs = Cache(tmp_path), Cache(tmp_path)
    shares = mine.shards(keys(200), "labels")
    sizes = {name: len(positions) for name, positions in shares.items()}
    assert sum(sizes.values()) == 200
    with mine.claim(sizes, 100) as claimed:
        assert 0 < sum(sizes[name] for name in claimed) <= 100
        with theirs.claim(sizes, 10**6) as rest:
            assert set(rest) == set(sizes) - set(claimed)
    with theirs.claim(sizes, 10**6) as everything:
        assert set(everything) == set(sizes)


def test_a_share_that_is_more_than_enough_is_claimed_alone(tmp_path: Path) -> None:
    with Cache(tmp_path).claim({"a": 50, "b": 1}, 10) as claimed:
        assert claimed == ["a"]


def test_other_calibrations_are_not_kept_waiting(tmp_path: Path) -> None:
    cache = Cache(tmp_path)
    one, two = cache.shards(keys(200), "krauss"), cache.shards(keys(200), "w99")
    assert len(set(one) & set(two)) <= 2


def test_the_locks_stay_few_however_many_calibrations_there_are(tmp_path: Path) -> None:
    cache = Cache(tmp_path)
    names = {name for number in range(400) for name in cache.shards(keys(40), str(number))}
    assert len(names) <= 4096


def test_without_a_cache_nothing_is_claimed_or_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shares = Cache(None).shards(keys(200), "labels")
    assert [sorted(positions) for positions in shares.values()] == [list(range(200))]
    with Cache(None).claim(dict.fromkeys(shares, 200), 10) as claimed:
        assert claimed == list(shares)
    assert not list(tmp_path.iterdir())


def test_a_cache_that_cannot_be_written_is_said_before_the_work(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with (
        pytest.raises(
            OutputError, match=r"cannot write the calibration cache.*cache\.enabled=false"
        ),
        Cache(tmp_path / "file").claim({"a": 1}, 1),
    ):
        pass
