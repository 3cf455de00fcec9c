"""The contract of an engine, statement by statement.

The work is trivial: squares of small numbers. A worker has to import this module to do it.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing

from cfx.core.engine import Engine, Report
from cfx.errors import DataError
from cfx_contracts import contract_of

SHARDS = 5


def _squares(shard: list[int], report: Report) -> list[int]:
    """Squares each number, and reports each."""
    squares = []
    for number in shard:
        squares.append(number * number)
        report(1)
    return squares


def _fails_at_three(shard: list[int], report: Report) -> int:
    if 3 in shard:
        raise DataError("the number 3 cannot be worked on; write 4 instead")
    report(len(shard))
    return len(shard)


def _shards() -> Iterator[list[int]]:
    """Yields shards of 1 to 5 numbers."""
    for number in range(SHARDS):
        yield list(range(number + 1))


def _nothing(_units: int) -> None:
    """Reports to nobody."""


def every_shard_has_its_own_result(engine: Engine) -> None:
    expected = {}
    for number, shard in enumerate(_shards()):
        expected[number] = [value * value for value in shard]
    for shares_cores in (True, False):
        with closing(engine):
            results = dict(engine.map(_squares, _shards(), _nothing, shares_cores=shares_cores))
        assert results == expected, (
            "map yields the number of each shard, as it was given, with its result, once each"
        )


def progress_adds_up(engine: Engine) -> None:
    reported: list[int] = []
    with closing(engine):
        list(engine.map(_squares, _shards(), reported.append))
    expected = sum(len(shard) for shard in _shards())
    assert sum(reported) == expected, (
        f"what the shards report arrives whole: {expected} units, not {sum(reported)}"
    )


def no_shards_are_no_work(engine: Engine) -> None:
    with closing(engine):
        results = list(engine.map(_squares, [], _nothing))
    assert results == [], "without a shard there is no result"


def what_the_work_raises_is_raised_again(engine: Engine) -> None:
    sentence = ""
    with closing(engine):
        try:
            list(engine.map(_fails_at_three, _shards(), _nothing))
        except DataError as error:
            sentence = str(error)
    assert "write 4 instead" in sentence, (
        "the error of a worker is the job's own error, with its sentence: it must not be lost, or"
        " the job would go on without the shard's result"
    )


def whoever_stops_listening_cancels_the_rest(engine: Engine) -> None:
    made = 0

    def endless() -> Iterator[list[int]]:
        nonlocal made
        while True:
            made += 1
            yield [made]

    with closing(engine):
        results = engine.map(_squares, endless(), _nothing)
        next(results)
        results.close()
    assert made < 10_000, "shards are made not long before they are worked on, however many follow"


def it_can_be_used_again_after_close(engine: Engine) -> None:
    for _ in range(2):
        results = dict(engine.map(_squares, [[2]], _nothing))
        engine.close()
        assert results == {0: [4]}, "close lets go of workers; map makes them again"


CONTRACT = contract_of(__name__, "engine")
