"""How many spoiled recordings are refused, and of how many the reason is named rightly.

    python -m tests.benchmarks.spoiled_files --data ../shared/data

Pairs of I-80 (reconstructed) and of OpenACC (ZalaZone) are written in each layout that cfx reads.
One thing is wrong in each file: a unit, a sign, a factor, the time step, two columns swapped; of
both vehicles or of one, in all pairs or in one. Each file is read as a job reads it. Prints for
each layout how many files were refused and how many reasons were named; precision and recall of
each reason; and each file whose reason was not named.
"""

from __future__ import annotations

import argparse
import re
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd

from cfx.core import registry
from cfx.data.base import Dataset
from cfx.data.pairs import Pair, PairSet
from cfx.data.signals import RECORDED
from cfx.data.tidy import TidyDataset
from cfx.errors import CfxError
from tests.data.layouts import write_fcd

FOOT = 0.3048
PAIRS = 6
RECORDINGS = {
    "I-80": ("i80_reconstructed_pairs.parquet", 600),
    "ZalaZone": ("openacc_zalazone_pairs.parquet", 900),
}
"""File, and how long a pair is at least, frames."""

Signals = dict[str, np.ndarray]
"""What a layout holds of a pair, in its units, `(T,)` each: position, speed, acceleration of leader
and follower, or gap and speeds; time."""

BOTH, LEADER, FOLLOWER = ("leader", "follower"), ("leader",), ("follower",)


def of(who: Sequence[str], what: str) -> list[str]:
    return [f"{one}_{what}" for one in who]


# --- layouts --------------------------------------------------------------------------------------


def _tidy(folder: Path, pairs: list[Signals], lengths: list[float]) -> dict[str, object]:
    parts = []
    for number, (signals, length) in enumerate(zip(pairs, lengths, strict=True)):
        about = {
            "recording": "r",
            "pair_id": f"p{number}",
            "frame": np.arange(len(signals["time"])),
        }
        about |= {"leader_id": f"{2 * number}", "follower_id": f"{2 * number + 1}"}
        units = {"position": "m", "speed": "mps", "acceleration": "mps2"}
        columns = {"time_s": signals["time"], "leader_length_m": length}
        if "gap" in signals:
            columns = {"time_s": signals["time"], "gap_m": signals["gap"]}
        for name, values in signals.items():
            if name not in {"time", "gap"}:
                columns[f"{name}_{units[name.partition('_')[2]]}"] = values
        parts.append(pd.DataFrame(about | columns))
    path = folder / "pairs.csv"
    pd.concat(parts).to_csv(path, index=False)
    return {"path": path}


def _followernet(folder: Path, pairs: list[Signals], _: list[float]) -> dict[str, object]:
    longest = max(len(one["time"]) for one in pairs)
    events = np.full((len(pairs), 4, longest), np.nan)
    for event, one in zip(events, pairs, strict=True):
        rows = one["gap"], one["follower_speed"], one["relative_speed"], one["leader_speed"]
        event[:, : len(one["time"])] = np.stack(rows)
    path = folder / "Lyft_train_data.npy"
    np.save(path, events)
    time = pairs[0]["time"]
    return {"path": path, "recorded_step": float(time[1] - time[0])}


def _openacc(folder: Path, pairs: list[Signals], _: list[float]) -> dict[str, object]:
    for number, one in enumerate(pairs):
        above = ("Date,30,09,2020", "Vehicle_order,Golf,XC40", "Number_of_vehicles,2", "ACC,1")
        table = {"Time": 36000 + one["time"], "Speed1": one["leader_speed"]}
        table |= {"Speed2": one["follower_speed"], "IVS1": one["gap"]}
        text = pd.DataFrame(table).to_csv(index=False)
        path = folder / f"platoon{number}.csv"
        path.write_text("\n".join((*above, "Distance_setting,shortest", text)))
    return {"path": folder / "platoon*.csv"}


def _ngsim(folder: Path, pairs: list[Signals], lengths: list[float]) -> dict[str, object]:
    rows = []
    for number, (one, length) in enumerate(zip(pairs, lengths, strict=True)):
        for place, who in enumerate(BOTH):
            frames = 1 + np.round(one["time"] / 0.1).astype(int)
            columns = {"Vehicle_ID": 2 * number + 1 + place, "Frame_ID": frames}
            columns |= {
                "Total_Frames": len(frames),
                "Global_Time": 1_113_433_136_300 + 100 * frames,
            }
            columns |= {"Local_X": 0.0, "Local_Y": one[f"{who}_position"], "Global_X": 0.0}
            columns |= {"Global_Y": 0.0, "v_Length": length, "v_Width": 6.0, "v_Class": 2}
            columns |= {"v_Vel": one[f"{who}_speed"], "v_Acc": one[f"{who}_acceleration"]}
            columns |= {"Lane_ID": 1 + number, "Preceding": place * (2 * number + 1)}
            columns |= {"Following": 0, "Space_Headway": 0.0, "Time_Headway": 0.0}
            rows.append(pd.DataFrame(columns))
    path = folder / "trajectories.csv"
    pd.concat(rows).to_csv(path, index=False)
    return {"path": path}


def _highd(folder: Path, pairs: list[Signals], lengths: list[float]) -> dict[str, object]:
    rows, meta = [], []
    for number, (one, length) in enumerate(zip(pairs, lengths, strict=True)):
        for place, who in enumerate(BOTH):
            vehicle, leader = 2 * number + 1 + place, place * (2 * number + 1)
            frames = 1 + np.arange(len(one["time"]))
            columns = {"frame": frames, "id": vehicle, "x": one[f"{who}_position"] - length}
            columns |= {"y": 8.0, "width": length, "height": 1.8, "yVelocity": 0.0}
            columns |= {"xVelocity": one[f"{who}_speed"], "yAcceleration": 0.0}
            columns |= {"xAcceleration": one[f"{who}_acceleration"], "precedingId": leader}
            columns |= {"followingId": 0, "laneId": 2 + number}
            columns |= dict.fromkeys(("dhw", "thw", "ttc", "precedingXVelocity"), 0.0)
            rows.append(pd.DataFrame(columns))
            about = {"id": vehicle, "width": length, "height": 1.8, "class": "Car"}
            about |= {"initialFrame": 1, "finalFrame": len(frames), "numFrames": len(frames)}
            meta.append(about | {"drivingDirection": 2})
    pd.concat(rows).sort_values(["frame", "id"]).to_csv(folder / "01_tracks.csv", index=False)
    pd.DataFrame(meta).to_csv(folder / "01_tracksMeta.csv", index=False)
    time = pairs[0]["time"]
    about = {"id": 1, "frameRate": 1 / (time[1] - time[0]), "locationId": 1}
    about["upperLaneMarkings"] = "8.5;12.6"
    pd.DataFrame([about]).to_csv(folder / "01_recordingMeta.csv", index=False)
    return {"path": folder / "01_tracks.csv", "max_gap": None}


def _waymo(folder: Path, pairs: list[Signals], lengths: list[float]) -> dict[str, object]:
    rows = []
    for number, (one, length) in enumerate(zip(pairs, lengths, strict=True)):
        for vehicle, who in zip((7, 0), BOTH, strict=True):
            columns = {"local_time": one["time"], "segment_id": number, "local_veh_id": vehicle}
            columns |= {"length": length, "follower_id": 0, "leader_id": 7}
            columns |= {"filter_pos": one[f"{who}_position"] - length / 2}
            columns |= {"filter_speed": one[f"{who}_speed"]}
            rows.append(pd.DataFrame(columns | {"filter_accer": one[f"{who}_acceleration"]}))
    path = folder / "all_seg_paired_cf_trj_final_with_large_vehicle.csv"
    pd.concat(rows).to_csv(path, index=False)
    return {"path": path}


def _lyft(folder: Path, pairs: list[Signals], lengths: list[float]) -> dict[str, object]:
    import zarr

    group = zarr.open_group(str(folder / "trainHH.zarr"), mode="w", zarr_format=2)
    ends = np.cumsum([len(one["time"]) for one in pairs])
    starts = np.concatenate([[0], ends[:-1]])
    arrays = {"index_range": np.stack([starts, ends], axis=1)}
    arrays["timestamp"] = np.concatenate([one["time"] for one in pairs])
    for short, who in (("lead", "leader"), ("follow", "follower")):
        arrays[f"{short}_size"] = np.array(lengths)
        middles = [one[f"{who}_position"] - k / 2 for one, k in zip(pairs, lengths, strict=True)]
        arrays[f"{short}_centroid"] = np.concatenate(middles)
        for name, signal in (("velocity", "speed"), ("acceleration", "acceleration")):
            values = [one[f"{who}_{signal}"] for one in pairs]
            arrays[f"{short}_{name}"] = np.concatenate(values)
    for name, values in arrays.items():
        group.create_array(name, data=values)
    return {"path": folder / "trainHH.zarr"}


def _fcd(folder: Path, pairs: list[Signals], _: list[float]) -> dict[str, object]:
    time = pairs[0]["time"]
    made = [_pair(number, one, 5.0) for number, one in enumerate(pairs)]
    made = [replace(one, dt=float(time[1] - time[0])) for one in made]
    path = write_fcd(folder / "fcd.xml", PairSet(tuple(made), "made"), leaders=False)
    return {"path": path, "max_gap": None}


def _pair(number: int, signals: Signals, length: float) -> Pair:
    named = {name: values for name, values in signals.items() if name != "time"}
    return Pair(
        pair_id=f"p{number}",
        recording="r",
        leader_id=f"{2 * number}",
        follower_id=f"{2 * number + 1}",
        dt=float(signals["time"][1] - signals["time"][0]),
        first_frame=0,
        leader_length=length,
        **named,
    )


class PluginsDataset(Dataset):
    """A dataset of a plugin, which gives pairs as they are."""

    pairs: tuple[Pair, ...] = ()

    def read(self) -> PairSet:
        return PairSet(self.pairs, "a plugin's")


def _plugin(_: Path, pairs: list[Signals], lengths: list[float]) -> dict[str, object]:
    made = []
    for number, (one, length) in enumerate(zip(pairs, lengths, strict=True)):
        made.append(_pair(number, one, length))
    PluginsDataset.pairs = tuple(made)
    return {}


@dataclass(frozen=True)
class Layout:
    """How pairs are written, and what the layout holds.

    Attributes:
        dataset: that reads it.
        write: writes pairs and their lengths into a folder, and returns settings.
        gaps: it has gaps in place of positions and accelerations.
        foot: metres in its unit of length.
        relative: it has the relative speed too.
        says_step: it says times, or a step.
    """

    dataset: str
    write: Callable[[Path, list[Signals], list[float]], Mapping[str, object]]
    gaps: bool = False
    foot: float = 1.0
    relative: bool = False
    says_step: bool = True

    def signals(self, pair: Pair) -> Signals:
        found = {"time": np.arange(len(pair)) * pair.dt}
        for who in BOTH:
            found[f"{who}_speed"] = getattr(pair, f"{who}_speed") / self.foot
            if not self.gaps:
                for what in ("position", "acceleration"):
                    found[f"{who}_{what}"] = getattr(pair, f"{who}_{what}") / self.foot
        if self.gaps:
            found["gap"] = pair.gap
        if self.relative:
            found["relative_speed"] = pair.leader_speed - pair.follower_speed
        return found


LAYOUTS = {
    "tidy": Layout("tidy", _tidy),
    "tidy with gaps": Layout("tidy", _tidy, gaps=True),
    "FollowNet": Layout("followernet", _followernet, gaps=True, relative=True),
    "OpenACC": Layout("openacc", _openacc, gaps=True, says_step=False),
    "NGSIM": Layout("ngsim", _ngsim, foot=FOOT, says_step=False),
    "highD": Layout("highd", _highd),
    "Waymo": Layout("waymo_pairs", _waymo),
    "Lyft": Layout("lyft_pairs", _lyft),
    "SUMO": Layout("sumo_fcd", _fcd),
    "plugin": Layout("", _plugin),
}


# --- what is spoiled ------------------------------------------------------------------------------

UNITS = {
    "speed": {"km/h": 1 / 3.6, "mph": 0.44704, "ft/s": FOOT, "m/s": 1.0},
    "position": {"ft": FOOT, "m": 1.0},
    "gap": {"ft": FOOT},
    "acceleration": {"g_0": 9.80665, "ft/s2": FOOT, "m/s2": 1.0},
}
"""Units in which a column may be by mistake, in SI units."""

REASONS = {
    **{
        unit: rf"look like {re.escape(unit)}(?![/\w])"
        for unit in ("km/h", "mph", "ft/s", "m/s", "ft", "m", "g_0", "ft/s2", "m/s2")
    },
    "sign": "sign is turned|positions must grow|against its lane's direction",
    "step": "the time step (looks like|is)|time steps differ",
    "swapped": "swapped",
    "factor": "[0-9.]+ times what the speeds say",
    "rows": "row 3 is not the difference",
}
"""Reasons by their names, and what is said of them."""


@dataclass(frozen=True)
class Spoiled:
    """What is wrong in a file.

    Attributes:
        name: in words.
        reason: the one that is right, of `REASONS`.
        who: what a message has to name besides: leader or follower; "" where it is both.
        change: of the signals of a pair.
        one: in one pair alone.
    """

    name: str
    reason: str
    who: str
    change: Callable[[Signals], Signals]
    one: bool = False


def times(factor: float, names: Sequence[str]) -> Callable[[Signals], Signals]:
    def change(signals: Signals) -> Signals:
        return signals | {name: signals[name] * factor for name in names}

    return change


def swapped(what: str) -> Callable[[Signals], Signals]:
    first, second = of(BOTH, what)
    return lambda signals: signals | {first: signals[second], second: signals[first]}


def every_second(signals: Signals) -> Signals:
    kept = {name: values[::2] for name, values in signals.items()}
    return kept | {"time": signals["time"][: len(kept["time"])]}


def spoiled(layout: Layout) -> Iterator[Spoiled]:
    """Yields all that is spoiled in files of a layout."""
    kinds = ("speed", "gap") if layout.gaps else ("speed", "position", "acceleration")
    for kind in kinds:
        for unit, size in UNITS[kind].items():
            factor = layout.foot / size
            if abs(factor - 1) < 1e-9:
                continue
            parts = [("", ["gap"])] if kind == "gap" else []
            if kind != "gap":
                both = of(BOTH, kind)
                parts = [("", both), ("leader", both[:1]), ("follower", both[1:])]
                if layout.relative:
                    parts[0] = ("", [*both, "relative_speed"])
            for who, names in parts:
                words = f"{who or 'all'} {kind}s in {unit}"
                if who and layout.relative:  # its file contradicts itself already
                    yield Spoiled(words, "rows", "", times(factor, names))
                    continue
                yield Spoiled(words, unit, who, times(factor, names))
                if not who:
                    yield Spoiled(f"{words}, one pair", unit, who, times(factor, names), one=True)
    yield Spoiled("speeds swapped", "swapped", "", swapped("speed"))
    if not layout.gaps:
        yield Spoiled("accelerations swapped", "swapped", "", swapped("acceleration"))
        both = of(BOTH, "acceleration")
        yield Spoiled("accelerations -1", "sign", "", times(-1, both))
        yield Spoiled("leader's acceleration -1", "sign", "leader", times(-1, both[:1]))
        yield Spoiled("accelerations 2", "factor", "", times(2, both))
        yield Spoiled("accelerations 9.81", "factor", "", times(9.81, both))
        yield Spoiled("positions -1", "sign", "", times(-1, of(BOTH, "position")))
        if layout.foot == 1:  # as if speeds and accelerations were in feet
            yield Spoiled("positions 0.3048", "ft/s", "", times(FOOT, of(BOTH, "position")))
    yield Spoiled("every second row left out", "step", "", every_second)
    if layout.says_step:
        for factor in (2.0, 0.5, 25 / 30, 1.1):
            yield Spoiled(f"step {factor:.3g}", "step", "", times(factor, ["time"]))


# --- the measurement ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Outcome:
    """What became of a file: `said` is None where it was accepted."""

    layout: str
    recording: str
    case: Spoiled
    said: str | None

    @property
    def named(self) -> list[str]:
        """The reasons that are named; of units those that stand there."""
        said = self.said or ""
        return [name for name, words in REASONS.items() if re.search(words, said)]

    @property
    def is_right(self) -> bool:
        return self.case.reason in self.named and self.case.who in (self.said or "")


def read(layout: Layout, pairs: Sequence[Pair], case: Spoiled | None, folder: Path) -> str | None:
    """Returns what a job says of a file; None if it is accepted."""
    signals = [layout.signals(pair) for pair in pairs]
    if case is not None:
        for number in range(len(signals)):
            if number == len(signals) // 2 or not case.one:
                signals[number] = case.change(signals[number])
    lengths = [(pair.leader_length or 4.5) / layout.foot for pair in pairs]
    settings = dict(layout.write(folder, signals, lengths))
    cls = registry.get("dataset", layout.dataset) if layout.dataset else PluginsDataset
    try:
        cls(min_duration=10, **settings).load()  # type: ignore[attr-defined]  # a dataset
    except CfxError as error:
        return str(error)
    return None


def chosen(data: Path, recording: str) -> list[Pair]:
    """Returns some pairs of a recording, over the whole file."""
    name, frames = RECORDINGS[recording]
    pairs = TidyDataset(
        path=data / name, min_duration=0.1 * frames, accelerations="recorded"
    ).load()
    cut = []
    for pair in pairs.pairs[:: max(1, len(pairs) // PAIRS)][:PAIRS]:
        cut.append(replace(pair, **{one: getattr(pair, one)[:frames] for one in RECORDED}))
    return cut


def outcomes(data: Path, layouts: Sequence[str]) -> Iterator[Outcome]:
    """Yields what became of each file; first that of a layout as it should be.

    Raises:
        AssertionError: one that is as it should be is refused.
    """
    for recording in RECORDINGS:
        pairs = chosen(data, recording)
        for name in layouts:
            layout = LAYOUTS[name]
            for case in (None, *spoiled(layout)):
                with tempfile.TemporaryDirectory() as folder:
                    said = read(layout, pairs, case, Path(folder))
                if case is None:
                    assert said is None, f"{name}, {recording}, as it should be: {said}"
                else:
                    yield Outcome(name, recording, case, said)


def show(found: Sequence[Outcome]) -> None:
    for layout in dict.fromkeys(one.layout for one in found):
        own = [one for one in found if one.layout == layout]
        refused = sum(one.said is not None for one in own)
        right = sum(one.is_right for one in own)
        print(f"{layout}: {len(own)} files, {refused} refused, {right} reasons named")
    print(
        f"all: {len(found)} files, {sum(one.said is not None for one in found)} refused,", end=" "
    )
    print(f"{sum(one.is_right for one in found)} reasons named")
    print("reason: precision (right of those named), recall (named of those that are)")
    for reason in REASONS:
        named = [one for one in found if reason in one.named]
        cases = [one for one in found if one.case.reason == reason]
        right = sum(one.is_right for one in cases)
        print(f"  {reason}: {right} of {len(named)}, {right} of {len(cases)}")
    for one in found:
        if not one.is_right:
            print(f"{one.layout}, {one.recording}, {one.case.name} ({one.case.reason}): {one.said}")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--layouts", nargs="+", choices=LAYOUTS, default=list(LAYOUTS))
    arguments = parser.parse_args()
    show(list(outcomes(arguments.data, arguments.layouts)))


if __name__ == "__main__":
    main()
