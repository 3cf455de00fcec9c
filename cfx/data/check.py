"""What becomes of pairs that contradict themselves: `data.check`."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from cfx.data.kinematics import Contradiction, Units, contradictions, typical_contradiction
from cfx.data.pairs import PairSet
from cfx.data.plausible import doubts
from cfx.errors import DataError, listed

log = logging.getLogger(__name__)

Check = Literal["drop_few", "drop", "refuse", "report", "off"]

_FEW = 20
"""Pairs that contradict themselves are few if they are less than one in so many: noise that a
recording has here and there. A wrong unit is in all of them."""

_SHOWN, _NAMED = 3, 20
"""Pairs that a message names for each reason; and that a count of what was left out names."""

_NUMBERS = re.compile(r"[0-9.]+")


@dataclass(frozen=True)
class Verdict:
    """What a check says of pairs.

    Attributes:
        words: what contradicts what, in which pairs; "" if nothing does.
        names: of the pairs that contradict themselves.
        left_out: those of them that are left out.
        is_refused: a job does not go on.
    """

    words: str
    names: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
    is_refused: bool = False

    @property
    def reason(self) -> str:
        """Why pairs are left out, and which they are."""
        names = listed([f"'{name}'" for name in self.left_out], _NAMED)
        return f"contradicting themselves (data.check): {names}"

    @property
    def consequence(self) -> str:
        """What a job does about it."""
        if self.is_refused:
            return "a job that uses them is refused (data.check)"
        if self.left_out:
            return "a job leaves them out (data.check)"
        return "a job goes on (data.check=report)"


def judge(pairs: PairSet, check: Check, units: Units | None = None) -> Verdict:
    """Compares the signals of pairs, and says what `data.check` does with those that disagree.

    What holds for a file as a whole, or for all pairs together, cannot be left out by pair.

    Args:
        pairs: in SI units.
        units: those that their file is said to have in place of SI units.
    """
    if check == "off" or not len(pairs):
        return Verdict("")
    broken = list(contradictions(pairs, units))
    names = tuple(dict(broken))
    sentences = [remark.text for remark in pairs.remarks if remark.is_contradiction]
    is_common = bool(sentences)
    if broken:
        sentences.append(_of_pairs(pairs, broken, units))
    can_leave_out = check == "drop" or (check == "drop_few" and _FEW * len(names) < len(pairs))
    typical = None
    if can_leave_out and not is_common:
        typical = typical_contradiction(_without(pairs, names))
    elif not broken:
        typical = typical_contradiction(pairs)
    if typical is not None:
        is_common = True
        sentences.append(
            f"the {len(pairs) - len(names)} pairs together contradict themselves:"
            f" {typical.text(units)}"
        )
    if not sentences:
        return Verdict("")
    words = f"{pairs.source}: {'; '.join(sentences)}"
    if check == "report":
        return Verdict(words, names)
    if is_common or not can_leave_out or len(names) == len(pairs):
        return Verdict(words, names, is_refused=True)
    return Verdict(words, names, left_out=names)


def check_pairs(
    pairs: PairSet, check: Check, units: Units | None = None, *, can_say_units: bool = False
) -> Verdict:
    """Refuses or reports pairs that contradict themselves, as `data.check` says; warns of doubts.

    Args:
        units: those that the file is said to have in place of SI units.
        can_say_units: settings can say others.

    Returns:
        The verdict, whose `left_out` the caller leaves out.

    Raises:
        DataError: they are refused.
    """
    if check == "off":
        return Verdict("")
    verdict = judge(pairs, check, units)
    if verdict.is_refused:
        remedies = ["correct the file"]
        if can_say_units:
            remedies.append("say which units it has (data.columns and data.units)")
        if verdict.names and len(verdict.names) < len(pairs):
            remedies.append("leave these pairs out (data.check=drop)")
        remedy = ", ".join(remedies)
        raise DataError(f"{verdict.words}; {remedy}, or say data.check=report to go on")
    if verdict.left_out:
        log.warning("%s; left out (data.check=%s)", verdict.words, check)
    elif verdict.words:
        log.warning("%s (data.check=report)", verdict.words)
    if verdict.left_out or not verdict.words:
        for doubt in doubts(pairs):
            log.warning("%s: %s", pairs.source, doubt)
    return verdict


def _without(pairs: PairSet, names: Sequence[str]) -> PairSet:
    """Returns the pairs that are not named."""
    left_out = frozenset(names)
    coherent = [number for number, pair in enumerate(pairs.pairs) if pair.pair_id not in left_out]
    return pairs.take(coherent)


def _of_pairs(
    pairs: PairSet, broken: Sequence[tuple[str, Contradiction]], units: Units | None
) -> str:
    """Returns which pairs contradict themselves, and how."""
    count = f"{len(broken)} of {len(pairs)} pairs contradict themselves"
    if len(broken) == 1:
        count = f"one of {len(pairs)} pairs contradicts itself"
    # Sentences that differ in their numbers alone are one.
    by_sentence: dict[str, list[tuple[str, Contradiction]]] = {}
    for name, contradiction in broken:
        sentence = _NUMBERS.sub("", contradiction.text(units))
        by_sentence.setdefault(sentence, []).append((name, contradiction))
    explanations = []
    for same_sentence in sorted(by_sentence.values(), key=len, reverse=True)[:_SHOWN]:
        names = listed([f"'{name}'" for name in dict(same_sentence)], _SHOWN)
        _, typical = sorted(same_sentence, key=_slope)[len(same_sentence) // 2]
        explanations.append(f"{typical.text(units)} (pairs: {names})")
    coherent = len(pairs) - len(broken)
    if coherent > len(broken):
        explanations.append(f"the other {coherent} pairs agree in these units")
    return f"{count}: {'; '.join(explanations)}"


def _slope(broken: tuple[str, Contradiction]) -> float:
    """Returns the slope of a pair's contradiction, by which the median one is typical."""
    return broken[1].slope or 0.0
