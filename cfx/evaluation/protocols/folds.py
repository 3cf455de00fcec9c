"""Folds of a cross-validation over drivers: who is tested in which, and who is learned from.

A pair's fold is a number: k where it is tested in fold k; -1 where it is only learned from; -2 - k
where it is too short to be tested, but belongs to a driver (platoon, recording) that is tested in
fold k, so that fold k does not learn from it.

Shapes: P pairs, K folds.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from sklearn.model_selection import GroupKFold
from torch import Tensor

from cfx.data.pairs import Pair, PairSet, of_each
from cfx.errors import DataError, listed

log = logging.getLogger(__name__)

__all__ = ["Together", "assign_folds"]
"""What plugins may use, as `cfx.plugin.folds`."""

Together = Literal["driver", "platoon", "vehicle", "recording", "site"]
"""What a fold keeps together."""


def assign_folds(
    pairs: PairSet, folds: int | None, together: Together, min_duration: float | None, *, seed: int
) -> Tensor:
    """Returns the fold of each pair, `(P,)` int64.

    Pairs that are too short to be tested do not change the folds of the others.

    Args:
        pairs: P pairs.
        folds: K; None: as many as there are drivers (platoons, ...), one of which is left out
            at a time.
        together: what a fold keeps together.
        min_duration: s that a tested pair lasts at least; None: all are tested.
        seed: of the shuffle.

    Raises:
        DataError: there are fewer drivers (platoons, ...) than folds, or one driver would be
            tested by a network that learned from them elsewhere.
    """
    groups = _groups(pairs, together)
    tested = []
    for number, pair in enumerate(pairs):
        if min_duration is None or pair.lasts(min_duration):
            tested.append(number)
    groups_tested = [groups[number] for number in tested]
    group_count = len(set(groups_tested))
    if group_count < (folds or 2):
        raise DataError(_too_few(pairs, folds, together, min_duration, group_count))
    if folds is None:
        folds = group_count
    splitter = GroupKFold(folds, shuffle=True, random_state=seed)
    fold_of_group: dict[Any, int] = {}
    parts = splitter.split(np.zeros(len(tested)), groups=groups_tested)
    for fold, (_, part) in enumerate(parts):
        for index in part:
            fold_of_group[groups_tested[index]] = fold
    long_enough = set(tested)
    assigned = []
    for number, group in enumerate(groups):
        if number in long_enough:
            assigned.append(fold_of_group[group])
        elif group in fold_of_group:
            assigned.append(-2 - fold_of_group[group])
        else:
            assigned.append(-1)
    _require_drivers_apart(pairs, assigned, together)
    return torch.tensor(assigned)


def _require_drivers_apart(pairs: PairSet, fold: Sequence[int], together: Together) -> None:
    """Raises DataError if a driver is tested in one fold and learned from for it."""
    first: dict[str, tuple[int, Pair]] = {}
    for number, pair in zip(fold, pairs, strict=True):
        place = number if number >= -1 else -2 - number
        other, elsewhere = first.setdefault(pair.driver, (place, pair))
        if other != place:
            raise DataError(
                f"protocol.together={together}: '{pair.driver}' drives in {elsewhere.recording} and"
                f" in {pair.recording}, of which one is learned from when the other is tested;"
                " write protocol.together=vehicle, or give both one site (data.site)"
            )


def learned_from(fold: Tensor, folds: int) -> Tensor:
    """Returns which pairs each network learns from, bool `(K + 1, P)`; the last from all."""
    number = torch.arange(folds + 1)[:, None]
    elsewhere = (fold != number) & (fold != -2 - number)
    return elsewhere | (number == folds)


def _too_few(
    pairs: PairSet, folds: int | None, together: Together, min_duration: float | None, groups: int
) -> str:
    what = together if groups == 1 else f"{together}s"
    if min_duration:
        what += f" whose pairs last {min_duration:g} s"
    if together == "site" and groups == 1:
        what += " (name those of its recordings with data.site)"
    more = f"{together}s" if together in {"recording", "site", "vehicle"} else "pairs"
    lower = f"lower protocol.min_test_duration={min_duration:g} or " if min_duration else ""
    if folds is None:
        return (
            f"protocol.together={together}: {pairs.source} has only {groups} {what} here, and one"
            f" is left out at a time; {lower}use more {more}"
        )
    return (
        f"protocol.folds={folds}: {pairs.source} has only {groups} {what} here; {lower}lower"
        f" protocol.folds (2 at least) or use more {more}"
    )


def _groups(pairs: PairSet, together: Together) -> Sequence[Any]:
    """Returns the group of each pair (its driver, platoon, ...); a fold has whole groups."""
    if together == "platoon":
        return _platoons(pairs)
    if together == "vehicle":
        return [pair.vehicle or pair.driver for pair in pairs]
    return of_each(pairs, together)


def _platoons(pairs: PairSet) -> list[int]:
    """Numbers the platoon of each pair: vehicles that follow one another, also through others."""
    leaders = list(map(_leader, pairs))
    followers = list(map(_follower, pairs))
    vehicles, numbers = np.unique([leaders, followers], return_inverse=True)
    leader, follower = numbers.reshape(2, len(pairs))
    # Vehicles are nodes, pairs are edges; a platoon is what hangs together.
    graph = coo_array((np.ones(len(pairs)), (leader, follower)), shape=(len(vehicles),) * 2)
    _, platoon_of_vehicle = connected_components(graph, directed=False)
    platoons: list[int] = platoon_of_vehicle[follower].tolist()
    return platoons


def _leader(pair: Pair) -> str:
    return f"{pair.recording}/{pair.leader_id}"


def _follower(pair: Pair) -> str:
    return f"{pair.recording}/{pair.follower_id}"


def describe_folds(pairs: PairSet, fold: Tensor, together: Together) -> dict[str, Any]:
    """Counts vehicles that stand on both sides of a fold, though never as followers; logs it.

    Args:
        pairs: P pairs.
        fold: `(P,)`, as `assign_folds` returns it.
        together: what a fold keeps together.

    Returns:
        What `data.json` says of the folds.
    """
    fold_of_pair = fold.tolist()
    folds = max(fold_of_pair) + 1
    fold_of_driver: dict[str, int] = {}
    recordings_of_fold: list[set[str]] = [set() for _ in range(folds)]
    tested, is_leader_known = 0, False
    for pair, number in zip(pairs, fold_of_pair, strict=True):
        is_leader_known |= pair.leader_id != f"ahead of {pair.follower_id}"
        if number >= 0:
            tested += 1
            fold_of_driver[pair.driver] = number
            recordings_of_fold[number].add(pair.recording)
    recordings = list(map(sorted, recordings_of_fold))
    behind_trained, leaders = _on_both_sides(pairs, fold_of_pair)
    if is_leader_known:
        log.info(
            "%d folds over %d drivers; test pairs behind a driver of the training part: %d of %d;"
            " tested drivers who lead one there: %d (both share the leader's trajectory alone)",
            folds,
            len(fold_of_driver),
            behind_trained,
            tested,
            len(leaders),
        )
    else:
        log.info(
            "%d folds over %d drivers; who leads whom is not known", folds, len(fold_of_driver)
        )
    if tested < len(pairs):
        log.info("%d shorter pairs are only learned from", len(pairs) - tested)
    if together in {"recording", "site"}:
        for number, names in enumerate(recordings):
            text = "Fold %d is tested on %s and learns nothing from there"
            log.info(text, number, listed(names, 3))
    drivers_of_fold = np.bincount(list(fold_of_driver.values()), minlength=folds)
    part = {"site": "site", "recording": "recording"}.get(together, "fold")
    return {
        "folds": folds,
        "pooled_over": f"{folds - 1} other {part}{'s' if folds > 2 else ''}",
        "recordings_per_fold": recordings,
        "drivers": len(fold_of_driver),
        "drivers_per_fold": drivers_of_fold.tolist(),
        "test_pairs_behind_a_training_driver": behind_trained if is_leader_known else None,
        "test_drivers_who_lead_a_training_pair": len(leaders) if is_leader_known else None,
        "pairs_only_learned_from": len(pairs) - tested,
    }


def _on_both_sides(pairs: PairSet, fold_of_pair: Sequence[int]) -> tuple[int, set[str]]:
    """Returns how many test pairs follow a training driver, and the test drivers who lead one.

    Args:
        pairs: P pairs.
        fold_of_pair: P numbers, as the module says: -2 - k is a short pair of fold k.
    """
    fold_of_follower: dict[str, int] = {}
    not_learned_in: dict[str, int] = {}
    for pair, number in zip(pairs, fold_of_pair, strict=True):
        if number >= 0:
            fold_of_follower[_follower(pair)] = number
        not_learned_in[_follower(pair)] = number if number >= 0 else -2 - number
    behind_trained = 0
    leaders = set()
    for pair, number in zip(pairs, fold_of_pair, strict=True):
        leader = _leader(pair)
        if number >= 0 and leader in not_learned_in and not_learned_in[leader] != number:
            behind_trained += 1
        fold_of_leader = fold_of_follower.get(leader)
        if fold_of_leader is not None and number not in {fold_of_leader, -2 - fold_of_leader}:
            leaders.add(leader)
    return behind_trained, leaders
