"""The tidy pair layout: the door through which any dataset enters.

One row per pair and frame, SI units, a constant time step within a pair, no gaps:

| column | unit | meaning |
| --- | --- | --- |
| `pair_id` | | a name, unique in the file |
| `recording`, `leader_id`, `follower_id` | | optional names, as in the source |
| `frame` | | optional; frames are consecutive |
| `time_s` | s | |
| `leader_position_m`, `follower_position_m` | m | front bumper, along the lane |
| `leader_speed_mps`, `follower_speed_mps` | m/s | |
| `leader_acceleration_mps2`, `follower_acceleration_mps2` | m/s2 | |
| `leader_length_m` | m | net gap = leader position - leader length - follower position |
| `gap_m` | m | optional, the net gap: lengths, positions and accelerations may then be left out |
| `driver_type`, `leader_driver_type` | | optional labels such as human or acc, one for each pair |
| `site` | | optional: the road or area of a recording; several recordings may share one |
| `vehicle` | | optional: the follower's name over all recordings, where it has one |
| `lane` | | optional, one value for each pair |
| further signals | as declared | optional: what inputs of policies read (`data.inputs`) |
| `true_model`, `true_NAME` | | optional: a synthetic driver's model and its parameters over time |

Without `recording` a file is one, without `follower_id` each pair is a driver of its own, without
`frame` a pair's rows are in the order of their times.

A file may call these otherwise (`data.columns`) and have other units (`data.units`).

A length of 0 says that the leader's position is that of its rear bumper. See
`cfx.data.tidy_checks.with_positions` for what follows from a column of gaps.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq
from pydantic import AfterValidator, Field, model_validator
from pydantic_core import PydanticCustomError

from cfx.core import memory
from cfx.core.component import Distinct, Settings
from cfx.core.files import atomic_write
from cfx.data.base import Contents, Dataset, FileDatasetSettings, joined
from cfx.data.files import (
    PARQUET,
    FileStart,
    Floats,
    Ints,
    are_partitions,
    beginning,
    of_recording,
    partitions,
    recording_of,
)
from cfx.data.pairs import Dropped, Pair, PairSet, frames_of_each, of_each
from cfx.data.signals import RECORDED, SIGNALS, Signal, declared_by, further_signals
from cfx.data.table import FileColumn, Layout, Table, read_table, table_of
from cfx.data.tidy_checks import GAP, LANE, LENGTH, TRUE, check, check_gap, time_steps
from cfx.data.units import factor
from cfx.errors import OutputError, listed

LABELS = ("recording", "pair_id", "leader_id", "follower_id")
"""Columns of names that every pair has."""

OPTIONAL_LABELS = {
    "true_model": "truth_model",
    "driver_type": "driver_type",
    "leader_driver_type": "leader_driver_type",
    "site": "site",
    "vehicle": "vehicle",
}
"""Columns of names that some files have, and the attributes of pairs that they hold."""


def _column_of(name: str) -> FileColumn:
    """Returns the column of a signal of every recording; beside gaps some may be left out."""
    signal = SIGNALS[name]
    if signal.quantity == "speed":
        return FileColumn(signal.column, signal.unit, least=signal.low, wrong=_REVERSING)
    return FileColumn(signal.column, signal.unit, unless=GAP)


_NGSIM = "This looks like an NGSIM file: use data=ngsim."
_REVERSING = "is negative; speeds count along the lane and must be 0 or more"

LAYOUT = Layout(
    name="the tidy layout",
    columns=(
        *[FileColumn(name, is_name=True, needed=name == "pair_id") for name in LABELS],
        FileColumn(
            "frame",
            needed=False,
            whole=True,
            wrong="is no whole number; number the frames 0, 1, 2, ...",
        ),
        FileColumn("time_s", "s"),
        *[_column_of(name) for name in RECORDED],
        FileColumn(
            LENGTH,
            "m",
            unless=GAP,
            least=0,
            wrong="is no vehicle length; give metres, or 0 where positions are of rear bumpers",
        ),
        FileColumn(GAP, "m", needed=False),
        FileColumn(LANE, needed=False, may_be_empty=True, whole=True, wrong="is no lane number"),
        *[
            FileColumn(name, is_name=True, needed=False, may_be_empty=True)
            for name in OPTIONAL_LABELS
        ],
        FileColumn(f"{TRUE}.+", many=True, needed=False, may_be_empty=True),
    ),
    keys={"pair": "pair_id", "frame": "frame"},
    elsewhere=dict.fromkeys(("Vehicle_ID", "vehicle_id", "Local_Y", "local_y"), _NGSIM),
    remedy="correct it or leave out the pair",
    parquet=True,
)


COLUMNS = {
    "recording": "recording",
    "pair_id": "pair_id",
    "leader_id": "leader_id",
    "follower_id": "follower_id",
    "frame": "frame",
    "time": "time_s",
    "position": SIGNALS["follower_position"].column,
    "speed": SIGNALS["follower_speed"].column,
    "acceleration": SIGNALS["follower_acceleration"].column,
    "leader_position": SIGNALS["leader_position"].column,
    "leader_speed": SIGNALS["leader_speed"].column,
    "leader_acceleration": SIGNALS["leader_acceleration"].column,
    "leader_length": LENGTH,
    "gap": GAP,
    "lane": LANE,
    "driver_type": "driver_type",
    "leader_driver_type": "leader_driver_type",
    "site": "site",
    "vehicle": "vehicle",
}
"""The layout's columns by their names in settings; what says no `leader_` is the follower's."""

_Name = Annotated[str, Field(min_length=1)] | None


class OwnColumns(Settings):
    """Settings: what a file calls its columns; a field for each column."""

    recording: _Name = None
    pair_id: _Name = None
    leader_id: _Name = None
    follower_id: _Name = None
    frame: _Name = None
    time: _Name = None
    position: _Name = Field(None, description="the follower's, as the next two")
    speed: _Name = None
    acceleration: _Name = None
    leader_position: _Name = None
    leader_speed: _Name = None
    leader_acceleration: _Name = None
    leader_length: _Name = None
    gap: _Name = Field(None, description="bumper to bumper")
    lane: _Name = None
    driver_type: _Name = None
    leader_driver_type: _Name = None
    site: _Name = None
    vehicle: _Name = None


def _of(si: str) -> AfterValidator:
    """Returns a check that a unit can be turned into an SI unit."""

    def check(unit: str | None) -> str | None:
        try:
            if unit is not None:
                factor(unit, si)
        except ValueError as error:
            raise PydanticCustomError("unit", "{reason}", {"reason": str(error)}) from None
        return unit

    return AfterValidator(check)


_Time = Annotated[str | None, _of("s")]
_Length = Annotated[str | None, _of("m")]
_Speed = Annotated[str | None, _of("m/s")]
_Acceleration = Annotated[str | None, _of("m/s2")]


class OwnUnits(Settings):
    """Settings: the units of the columns that a file calls by names of its own."""

    time: _Time = Field(None, description="null: s")
    position: _Length = Field(None, description="of the follower; null: m")
    speed: _Speed = Field(None, description="of the follower; null: m/s")
    acceleration: _Acceleration = Field(None, description="of the follower; null: m/s2")
    leader_position: _Length = Field(None, description="null: as position")
    leader_speed: _Speed = Field(None, description="null: as speed")
    leader_acceleration: _Acceleration = Field(None, description="null: as acceleration")
    leader_length: _Length = Field(None, description="null: m")
    gap: _Length = Field(None, description="null: m")


class TidySettings(FileDatasetSettings):
    """Settings of the reader of tidy pairs."""

    columns: OwnColumns = Field(
        OwnColumns(),
        description="the file's own names of its columns, such as columns.speed=v_kmh; null: as"
        " the layout calls them",
    )
    units: OwnUnits = Field(
        OwnUnits(),
        description="the units of columns that are named above, such as units.speed=km/h",
    )
    inputs: Distinct[tuple[str, ...]] = Field(
        (),
        description="inputs of policies whose further signals are read from columns of the file,"
        " such as [rain]; a job adds those of policy.inputs",
    )

    @model_validator(mode="after")
    def _columns_and_units_agree(self) -> TidySettings:
        """Refuses two quantities in one column, and units of columns that have their own."""
        self.own_layout()
        return self

    def own_layout(self) -> Layout:
        """Returns the layout with the file's own names and units.

        Raises:
            ValueError: one column would be two, or a unit is given for a column whose own name has
                another.
        """
        by_name = {column.name: column for column in LAYOUT.columns}
        for name, plain in COLUMNS.items():
            by_name[plain] = self._own(name, by_name[plain])
        settings = {plain: name for name, plain in COLUMNS.items()}
        quantities: dict[str, str] = {}
        for column in by_name.values():
            quantity = settings.get(column.name, column.name)
            if column.title in quantities:
                other = quantities[column.title]
                raise ValueError(
                    f"data.columns: the column {column.title} would be both {other}"
                    f" and {quantity}; name another one"
                )
            quantities[column.title] = quantity
        columns = []
        for column in by_name.values():
            unless = ""
            if column.unless:
                unless = by_name[GAP].title
            columns.append(replace(column, unless=unless))
        return replace(LAYOUT, columns=tuple(columns))

    def further_signals(self) -> tuple[Signal, ...]:
        """Returns the signals that `inputs` read beyond those of every recording.

        Raises:
            PluginError: there is no such input, or two declare a signal in different ways.
        """
        signals: list[Signal] = []
        for name in self.inputs:
            signals += declared_by(name)
        return further_signals(signals)

    def unit_of(self, name: str) -> str | None:
        """Returns the unit that the file has for a quantity in place of the layout's; or None."""
        if getattr(self.columns, name) is None:
            return None
        unit: str | None = getattr(self.units, name, None)
        return unit or getattr(self.units, name.removeprefix("leader_"), None)

    def _own(self, name: str, column: FileColumn) -> FileColumn:
        """Returns a column with the name and the unit that the file has for it."""
        called = getattr(self.columns, name)
        if called is not None:
            scale = 1.0
            if column.unit:
                scale = factor(self.unit_of(name) or column.unit, column.unit)
            return replace(column, called=called, factor=scale, needed=True, unless="")
        unit = getattr(self.units, name, None)
        if unit is not None and factor(unit, column.unit) != 1.0:
            raise ValueError(
                f"data.units.{name}={unit}: the column {column.name} is in {column.unit}, as its"
                f" name says; name the file's column in data.columns.{name}"
            )
        return column


class TidyDataset(Dataset):
    """Pairs in the tidy layout (see the module), from parquet or CSV; gzipped CSV is fine.

    Columns may have names and units of the file's own (`columns`, `units`).

    A folder stands for the parquet files in it, one recording each (`cfx.data.files.partitions`).
    With `data.recording` the others are not read.

    Rows may be in any order. Several files are read as one: a recording may go on in another file,
    a pair may not.

    Columns beyond the layout are ignored and counted. Everything else that does not fit is an error
    that names row and column.
    """

    layout = "tidy pairs (SI units)"
    schema: ClassVar[type[Settings]] = TidySettings
    settings: TidySettings

    @classmethod
    def recognises(cls, start: FileStart) -> bool:
        if are_partitions(start.path):
            return True
        needed = set()
        for column in LAYOUT.columns:
            if column.needed:
                needed.add(column.name)
        if start.magic == PARQUET and not start.columns:
            return True  # a damaged one: the reader says so
        return len(needed & set(start.columns)) >= 3

    def contents(self) -> Contents:
        gap = self.settings.columns.gap or GAP
        has_gaps = True
        for file in self._files():
            has_gaps &= gap in beginning(file).columns
        contents = super().contents()._replace(has_gaps=has_gaps)
        unnamed = self._unnamed()
        if not unnamed:
            return contents
        vehicles = set()
        for pair in contents.pairs:
            if "leaders" not in unnamed:
                vehicles.add((pair.recording, pair.leader_id))
            if "followers" not in unnamed:
                vehicles.add((pair.recording, pair.follower_id))
        words = f"{' and '.join(unnamed)} have no ids"
        return contents._replace(vehicles=len(vehicles), unnamed=words)

    def _unnamed(self) -> list[str]:
        """Returns who has no ids in some file: leaders, followers, both or neither."""
        columns = self.settings.columns
        ids = {
            "leaders": columns.leader_id or "leader_id",
            "followers": columns.follower_id or "follower_id",
        }
        unnamed = []
        for who, name in ids.items():
            if any(name not in beginning(file).columns for file in self._files()):
                unnamed.append(who)
        return unnamed

    def _files(self) -> list[Path]:
        """Returns the files that are read: of a folder, those of the recording that is chosen."""
        files: list[Path] = []
        for path in self.settings.files():
            files += partitions(path)
        return of_recording(files, self.settings.recording)

    def read(self) -> PairSet:
        layout = self.settings.own_layout()
        signals = self.settings.further_signals()
        return joined(read_tidy(file, layout, signals) for file in self._files())

    def units(self) -> Mapping[str, str]:
        units = {}
        for name in OwnUnits.model_fields:
            unit = self.settings.unit_of(name)
            if unit:
                units[name] = unit
        return units


def read_tidy(path: Path, layout: Layout = LAYOUT, signals: Sequence[Signal] = ()) -> PairSet:
    """Reads a tidy file.

    Args:
        layout: the tidy layout, perhaps with the file's own names and units.
        signals: further ones that are read too.

    Raises:
        DataError: the file cannot be read or does not keep to the layout.
    """
    recording = recording_of(path)
    labels = {}
    if recording is not None:
        labels["recording"] = recording
    return _pairs(read_table(path, _with_signals(layout, signals), labels), signals)


def pairs_from_frame(
    frame: Any,
    source: str = "table",
    layout: Layout = LAYOUT,
    signals: Sequence[Signal] = (),
) -> PairSet:
    """Takes pairs from a table in the tidy layout.

    Args:
        frame: a data frame of any library (`cfx.data.frames`).
        source: what messages call the table; its rows are counted from 1.
        layout: the tidy layout, perhaps with the table's own names and units.
        signals: further ones that are taken too.

    Raises:
        DataError: the table does not keep to the layout.
    """
    return _pairs(table_of(frame, _with_signals(layout, signals), source), signals)


def _with_signals(layout: Layout, signals: Sequence[Signal]) -> Layout:
    """Returns a layout that has the columns of further signals too."""
    columns = list(layout.columns)
    for signal in signals:
        bounds = f"{signal.low:g} to {signal.high:g} {signal.unit}".rstrip()
        columns.append(
            FileColumn(
                signal.column,
                signal.unit,
                least=signal.low,
                most=signal.high,
                wrong=f"is no possible {signal.meaning}, which is {bounds}",
            )
        )
    return replace(layout, columns=tuple(columns))


def row_order(frame: Any) -> Ints:
    """Returns a table's rows `(N,)` in the order in which `pairs_from_frame` takes them.

    That is pair by pair, as they first appear, and by time within each.

    Raises:
        DataError: as `pairs_from_frame`.
    """
    table = table_of(frame, LAYOUT, "table")
    time = table.numbers.get("frame", table.numbers["time_s"])
    return np.lexsort((time, table.labels["pair_id"].codes))


def _pairs(table: Table, signals: Sequence[Signal]) -> PairSet:
    table, order, starts = check(table)
    dropped: tuple[Dropped, ...] = ()
    if table.ignored:
        reason = f"not part of the layout: {listed(table.ignored)}"
        dropped = (Dropped(reason, len(table.ignored), "columns"),)
    pairs = tuple(_build(table, order, starts, signals))
    check_gap(table, pairs)
    return PairSet(pairs, table.source, dropped)


def _build(table: Table, order: Ints, starts: Ints, signals: Sequence[Signal]) -> list[Pair]:
    """Returns the pairs of a table as `check` orders them.

    Args:
        table: that was checked.
        order, starts: as `check` gives them.
        signals: further ones that the pairs shall have.
    """
    numbers = {name: values[order] for name, values in table.numbers.items()}
    steps = time_steps(numbers["time_s"], starts)
    ends = np.append(starts[1:], len(order))
    pairs = []
    for start, end, step in zip(starts.tolist(), ends.tolist(), steps.tolist(), strict=True):
        row = int(order[start])
        truth = {}
        for name in numbers:
            if name.startswith(TRUE) and not np.isnan(numbers[name][start]):
                truth[name.removeprefix(TRUE)] = numbers[name][start:end]
        lane = None
        if LANE in numbers and not np.isnan(numbers[LANE][start]):
            lane = int(numbers[LANE][start])
        fields: dict[str, Any] = {}
        for name in LABELS:
            fields[name] = table.labels[name].at(row)
        for name, attribute in OPTIONAL_LABELS.items():
            if name in table.labels:
                fields[attribute] = table.labels[name].at(row)
        for name in RECORDED:
            fields[name] = numbers[SIGNALS[name].column][start:end]
        surroundings = {}
        for signal in signals:
            surroundings[signal] = numbers[signal.column][start:end]
        pair = Pair(
            **fields,
            first_frame=int(numbers["frame"][start]),
            dt=_simplest(step),
            leader_length=float(numbers[LENGTH][start]),
            lane=lane,
            truth=truth,
            surroundings=surroundings,
        )
        pairs.append(pair)
    return pairs


_CAMERAS = tuple(Fraction(1001, 1000 * rate) for rate in (24, 30, 48, 60, 120))
"""Time steps of television's frame rates, s: 30 frames per second are 29.97."""


def _simplest(step: float) -> float:
    """Returns the time step that a mean of rounded times stands for.

    It is 0.1 for 0.09999999998, 1/30 for 0.0333333, and 1001/30000 for a camera's 29.97 frames per
    second.
    """
    candidates = [Fraction(step).limit_denominator(100), *_CAMERAS]
    candidates.append(Fraction(step).limit_denominator(10_000))
    for simple in candidates:
        if simple > 0 and abs(float(simple) - step) < 1e-6 * step:
            return float(simple)
    return step


_PAIRS_AT_ONCE = 1024
"""Pairs that are in one table while they are written."""

# --- writing --------------------------------------------------------------------------------------


def write_tidy(pairs: PairSet, path: Path | str) -> None:
    """Writes pairs in the tidy layout.

    Reading the file gives the same pairs to the last bit, truth included. The file appears whole or
    not at all. `time_s` is frame times time step.

    Args:
        path: ends in .parquet, .csv or .csv.gz.

    Raises:
        OutputError: the name ends otherwise, or the file cannot be written.
    """
    path = Path(path).expanduser()
    if not path.name.lower().endswith((".parquet", ".csv", ".csv.gz")):
        raise OutputError(f"{path}: a tidy file is named .parquet, .csv or .csv.gz")
    try:
        with atomic_write(path) as temporary:
            _write(_tables(pairs), temporary, path.name.lower())
    except OSError as error:
        raise OutputError(
            f"{path}: cannot be written ({error.strerror or error});"
            " choose another folder or free some space"
        ) from None


def frame_of(pairs: PairSet) -> pd.DataFrame:
    """Returns pairs as a table in the tidy layout."""
    frame: pd.DataFrame = pa.concat_tables(_tables(pairs)).to_pandas()
    return frame


def _write(tables: Iterator[Any], temporary: Path, name: str) -> None:
    """Writes tables with the same columns, one behind the other."""
    first = next(tables)
    with ExitStack() as opened:
        if name.endswith(".parquet"):
            writer = pq.ParquetWriter(temporary, first.schema, compression="zstd")
        else:
            compression = None
            if name.endswith(".gz"):
                compression = "gzip"
            stream = opened.enter_context(pa.output_stream(str(temporary), compression=compression))
            writer = pa.csv.CSVWriter(stream, first.schema)
        opened.enter_context(writer)
        for table in itertools.chain([first], tables):
            writer.write_table(table)


def _tables(pairs: PairSet) -> Iterator[Any]:
    """Yields pairs as Arrow tables in the tidy layout, some pairs after the other; one at least."""
    optional = set()
    for pair in pairs.pairs:
        if pair.lane is not None:
            optional.add(LANE)
        for name, attribute in OPTIONAL_LABELS.items():
            if getattr(pair, attribute):
                optional.add(name)
    truths, signals = _truth_names(pairs), pairs.surroundings
    for start in range(0, max(1, len(pairs)), _PAIRS_AT_ONCE):
        yield _as_table(pairs[start : start + _PAIRS_AT_ONCE], optional, truths, signals)
        memory.release()


def _as_table(
    pairs: Sequence[Pair],
    optional: Collection[str],
    truths: Sequence[str],
    signals: Sequence[Signal],
) -> Any:
    """Returns pairs as an Arrow table with some of the optional columns and further signals."""
    pair_of_row = pa.array(np.repeat(np.arange(len(pairs)), frames_of_each(pairs)))

    def per_pair(values: Sequence[Any], kind: Any) -> Any:
        return pa.array(values, kind).take(pair_of_row)

    frames, times = [], []
    for pair in pairs:
        frame = pair.first_frame + np.arange(len(pair))
        frames.append(frame)
        times.append(np.asarray(frame * pair.dt, np.float64))

    columns: dict[str, Any] = {}
    for name in LABELS:
        columns[name] = per_pair(of_each(pairs, name), pa.string())
    columns["frame"] = pa.array(np.concatenate([np.zeros(0, np.int64), *frames]), pa.int64())
    columns["time_s"] = _over_time(times)
    for name in RECORDED:
        columns[SIGNALS[name].column] = _over_time(of_each(pairs, name))
    columns[LENGTH] = per_pair(of_each(pairs, "leader_length"), pa.float64())
    if LANE in optional:
        columns[LANE] = per_pair(of_each(pairs, "lane"), pa.int64())
    for name, attribute in OPTIONAL_LABELS.items():
        if name in optional:
            columns[name] = per_pair(of_each(pairs, attribute), pa.string())
    for name in truths:
        values = []
        for pair in pairs:
            unknown = np.full(len(pair), np.nan)
            values.append(pair.truth.get(name, unknown))
        columns[TRUE + name] = _over_time(values)
    for signal in signals:
        columns[signal.column] = _over_time([pair.surroundings[signal] for pair in pairs])
    return pa.table(columns)


def _over_time(arrays: Sequence[Floats]) -> Any:
    """Returns the values of all pairs one after the other."""
    return pa.array(np.concatenate([np.zeros(0), *arrays]), pa.float64())


def _truth_names(pairs: PairSet) -> list[str]:
    """Returns the true parameters that any pair has, in the order in which they come."""
    names: list[str] = []
    for pair in pairs.pairs:
        for name in pair.truth:
            if name not in names:
                names.append(name)
    return names
