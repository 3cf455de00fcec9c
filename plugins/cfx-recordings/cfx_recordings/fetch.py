"""Downloads NGSIM's recordings of I-80 from the U.S. Department of Transportation's open data.

The service speaks SODA: https://dev.socrata.com/docs/queries. A query's rows come in pages, sorted
by the service's own row id (`$order=:id`), so that a download that was broken off goes on with the
pages that it lacks. `requests` with urllib3's `Retry` fits better than a downloader of whole files
such as pooch: a page counts only if it holds the right number of rows, and a busy service (429,
503) says itself how long to wait.
"""

from __future__ import annotations

import csv
import io
import json
import logging
import math
import os
import re
import shutil
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from filelock import FileLock, Timeout

from cfx.errors import ConfigError, DataError, OutputError
from cfx.plugin import Task, files
from cfx_recordings.ngsim import MOTORWAY

if TYPE_CHECKING:
    from requests import Response, Session

log = logging.getLogger(__name__)

URL = "https://data.transportation.gov/resource/8ect-6jqj.csv"
BY_HAND = "https://data.transportation.gov/api/views/8ect-6jqj/rows.csv?accessType=DOWNLOAD"

PAGE_ROWS = 50_000
"""Rows asked for at once: the most that every version of the service's interface gives."""

TOKEN = "SOCRATA_APP_TOKEN"  # noqa: S105 - the name of the environment variable
"""Environment variable for an application token, with which the service lets one ask more often.

It is not needed.
"""

COLUMNS = (*MOTORWAY, "Location")
"""NGSIM's columns for a highway; the service writes them in small letters."""

_QUARTER_MS = 900_000
_START_MS = {"0400": 1_113_433_200_000, "0500": 1_113_436_800_000, "0515": 1_113_437_700_000}
"""When the recordings begin, as `Global_Time` counts.

It is 4:00, 5:00 and 5:15 pm in California on 13 April 2005.
"""

RECORDINGS = (*_START_MS, "all")

_BEFORE_MS, _AFTER_MS = 180_000, 300_000
"""Margins around a recording: it may start a minute early, and follows the last vehicles out."""

_EDGE_MS = 1_000
"""Rows so close to the margin's end mean that the recording may go on beyond it."""

_TRIES = 3
_TIMEOUTS = (15.0, 180.0)
"""To connect and to wait for an answer, s."""

_LONGEST_WAIT_S = 300
_BUSY = (202, 429, 500, 502, 503, 504)
"""Answers of a busy service; 202: it is still working on the answer."""


@dataclass(frozen=True)
class Query:
    """Query to the service; an interrupted download continues only with the same one.

    Attributes:
        url: of the data set.
        where: SoQL's filter of rows.
        rows: how many rows the service has for it.
        page_rows: rows of a page.
        columns: what is asked for.
    """

    url: str
    where: str
    rows: int
    page_rows: int
    columns: tuple[str, ...] = COLUMNS

    def pages(self) -> list[tuple[int, int]]:
        """Returns `(offset, rows)` of each page."""
        pages = []
        for first in range(0, self.rows, self.page_rows):
            pages.append((first, min(self.page_rows, self.rows - first)))
        return pages


class Service:
    """A SODA service.

    Args:
        url: address of the data set, ending in `.csv`.
        kept: where pages lie, for messages.
        wait_s: seconds before the second attempt at a busy service that does not say how long to
            wait; doubled each time.
    """

    def __init__(self, url: str, kept: Path, wait_s: float) -> None:
        if not url.startswith(("http://", "https://")):
            raise ConfigError(f"--url {url} is no address of a SODA service; write one like {URL}")
        self.url = url
        self.name = urlsplit(url).netloc
        self._kept = kept
        self._session = _session(wait_s)

    def count(self, where: str) -> int:
        """Returns how many rows there are.

        Raises:
            DataError: the service cannot be reached, or answers with something else.
        """
        table = _table(self._get({"$select": "count(*)", "$where": where}))
        if len(table) != 2 or len(table[1]) != 1 or not table[1][0].isdigit():
            raise self._nonsense("a number of rows", table)
        return int(table[1][0])

    def page(self, query: Query, offset: int, rows: int) -> str:
        """Returns a page, a CSV of `rows` rows and a header.

        Raises:
            DataError: the service cannot be reached, or has not sent the page whole after three
                attempts.
        """
        parameters = {
            "$select": ",".join(query.columns).lower(),
            "$where": query.where,
            "$order": ":id",
            "$limit": str(query.page_rows),
            "$offset": str(offset),
        }
        received = 0
        for _ in range(_TRIES):
            text = self._get(parameters)
            table = _table(text)
            if not _has_columns(table, query.columns):
                raise self._nonsense("the data set's columns", table)
            received = len(table) - 1
            if received == rows and all(len(row) == len(query.columns) for row in table):
                return text
        raise DataError(
            f"{self.name} sent {received} instead of {rows} rows from row {offset} on, {_TRIES}"
            f" times; run the same command later: the pages in {self._kept} are kept"
        )

    def close(self) -> None:
        """Closes its connections."""
        self._session.close()

    def _get(self, parameters: dict[str, str]) -> str:
        """Returns the service's answer to a query; raises DataError where it gives none."""
        answer = self._answer(parameters)
        if answer.status_code in _BUSY:
            raise self._unreachable(
                f"it answers {answer.status_code} {answer.reason}, again and again"
            )
        if not answer.ok:
            raise DataError(
                f"{self.name} refuses the query ({_complaint(answer)});"
                f" is {self.url} the data set's address?"
            )
        return answer.content.decode("utf-8-sig", errors="replace")

    def _answer(self, parameters: dict[str, str]) -> Response:
        """Asks, and asks again if the connection breaks in the middle of a page."""
        from requests import RequestException
        from requests.exceptions import ChunkedEncodingError, ContentDecodingError

        for attempt in range(1, _TRIES + 1):
            try:
                return self._session.get(self.url, params=parameters, timeout=_TIMEOUTS)
            except (ChunkedEncodingError, ContentDecodingError) as error:
                if attempt == _TRIES:
                    raise self._unreachable(_reason(error)) from None
            except RequestException as error:
                raise self._unreachable(_reason(error)) from None
        raise AssertionError("unreachable")

    def _unreachable(self, reason: str) -> DataError:
        kept = ""
        if any(self._kept.glob("*.csv")):
            kept = f" (the pages in {self._kept} are kept)"
        return DataError(
            f"{self.name} cannot be reached: {reason}; run the same command again when it"
            f" can{kept}, or download {BY_HAND} by hand and use data=ngsim data.path=FILE"
            " data.location=i-80"
        )

    def _nonsense(self, wanted: str, table: Sequence[Sequence[str]]) -> DataError:
        begins = "nothing"
        if table:
            begins = ",".join(table[0])[:60]
        return DataError(
            f"{self.name} answered with something else than {wanted}: '{begins}';"
            f" is {self.url} the data set's address, and does a proxy or a log-in page stand"
            " between?"
        )


def fetch_ngsim_i80(
    folder: Path,
    recording: str = "0400",
    *,
    url: str = URL,
    force: bool = False,
    page_rows: int = PAGE_ROWS,
    wait_s: float = 1.0,
) -> Path:
    """Downloads a recording of I-80, or all three, into one CSV file in NGSIM's layout.

    A finished file is left alone.

    Args:
        folder: where the file, and its pages until it is finished, are put; made if it is not
            there.
        recording: one of `RECORDINGS`.
        url: of the data set, another one for a mirror.
        force: download again, and replace a finished file.
        page_rows: rows of a page.
        wait_s: seconds before the second attempt at a busy service.

    Returns:
        The file's path.

    Raises:
        ConfigError: `recording` or `url` is none.
        DataError: the service cannot be reached, or sent something else; the pages that came are
            kept.
        OutputError: the folder cannot be written.
    """
    if recording not in RECORDINGS:
        raise ConfigError(f"--recording {recording}: known are {', '.join(RECORDINGS)}")
    path = folder / f"ngsim-i80-{recording}.csv"
    if path.exists() and not force:
        log.info("%s is there already; --force downloads it again", path)
        return path
    kept = folder / f"{path.stem}.pages"
    with closing(Service(url, kept, wait_s)) as service:
        query = Query(url, _where(recording), service.count(_where(recording)), page_rows)
        if not query.rows:
            raise DataError(
                f"{service.name} has no rows for {query.where}; is {url} the data set's address?"
            )
        with _writing(folder), _alone(kept):
            _fetch_pages(service, query, kept)
            _check_unchanged(service, query)
            rows = _join(kept, query, path, recording)
    log.info("%s: %s rows", path, f"{rows:,}")
    shutil.rmtree(kept, ignore_errors=True)
    return path


def _where(recording: str) -> str:
    """Returns the filter of a recording's rows, with margins.

    Overlapping recordings are told apart afterwards.
    """
    if recording == "all":
        return "location='i-80'"
    first, last = _window(recording)
    return f"location='i-80' AND global_time >= {first} AND global_time <= {last}"


def _window(recording: str) -> tuple[int, int]:
    start = _START_MS[recording]
    return start - _BEFORE_MS, start + _QUARTER_MS + _AFTER_MS


def _fetch_pages(service: Service, query: Query, kept: Path) -> None:
    """Downloads the pages that are not there yet."""
    _start_over_if_changed(query, kept)
    pages = query.pages()
    missing = []
    missing_rows = 0
    for offset, rows in pages:
        if not _is_whole(_page(kept, offset), query, rows):
            missing.append((offset, rows))
            missing_rows += rows
    here = ""
    if len(missing) < len(pages):
        here = f", {len(pages) - len(missing)} are here already"
    log.info("%s: %s rows in %s pages%s", service.name, f"{query.rows:,}", len(pages), here)
    with Task(f"downloading from {service.name}", missing_rows) as task:
        for offset, rows in missing:
            text = service.page(query, offset, rows)
            with files.atomic_write(_page(kept, offset)) as partial:
                partial.write_text(text, encoding="utf-8", newline="")
            task.advance(rows)


def _check_unchanged(service: Service, query: Query) -> None:
    now = service.count(query.where)
    if now != query.rows:
        raise DataError(
            f"{service.name} had {query.rows} rows when the download began and has {now} now;"
            " run the same command again"
        )


def _start_over_if_changed(query: Query, kept: Path) -> None:
    """Drops pages of another query, or of the same one when the service had other rows."""
    note = kept / "query.json"
    now = json.dumps(asdict(query))
    if note.is_file() and note.read_text(encoding="utf-8") == now:
        return
    old = list(kept.glob("*.csv"))
    if old:
        log.info("%s: the service's data or the question has changed; starting over", kept)
    for page in old:
        page.unlink()
    with files.atomic_write(note) as partial:
        partial.write_text(now, encoding="utf-8")


def _page(kept: Path, offset: int) -> Path:
    return kept / f"{offset:09d}.csv"


def _is_whole(page: Path, query: Query, rows: int) -> bool:
    if not page.is_file():
        return False
    table = _table(page.read_text(encoding="utf-8"))
    return _has_columns(table, query.columns) and len(table) == rows + 1


def _join(kept: Path, query: Query, path: Path, recording: str) -> int:
    """Writes the pages' rows that are of the recording to one file; returns their number."""
    written = 0
    earliest, latest = math.inf, 0.0
    with (
        files.atomic_write(path) as partial,
        partial.open("w", encoding="utf-8", newline="") as file,
    ):
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for offset, _ in query.pages():
            rows = _table(_page(kept, offset).read_text(encoding="utf-8"))
            for row in rows[1:]:
                clock, of = _recording(row)
                if recording in (of, "all"):
                    writer.writerow(row)
                    written += 1
                    earliest = min(earliest, clock)
                    latest = max(latest, clock)
        _check_margins(recording, written, earliest, latest)
    return written


def _recording(row: Sequence[str]) -> tuple[float, str]:
    """Returns a row's time, in ms, and its recording: the one that begins next to its frame 0.

    The time alone would not do: vehicles of one recording are still followed when the next has
    begun.
    """
    try:
        frame = float(row[COLUMNS.index("Frame_ID")])
        clock = float(row[COLUMNS.index("Global_Time")])
    except ValueError:
        raise DataError(
            f"the service sent a row without a frame or a time: {','.join(row)}"
        ) from None
    start = clock - 100 * frame
    return clock, min(_START_MS, key=lambda name: abs(start - _START_MS[name]))


def _check_margins(recording: str, rows: int, earliest: float, latest: float) -> None:
    """Raises DataError if the recording may go on beyond what was asked for."""
    if not rows:
        raise DataError(f"the service has no rows of recording {recording}; try --recording all")
    if recording != "all":
        first, last = _window(recording)
        if earliest < first + _EDGE_MS or latest > last - _EDGE_MS:
            raise DataError(
                f"recording {recording} is longer than known and would be cut; use --recording all"
            )


def _table(text: str) -> list[list[str]]:
    return [row for row in csv.reader(io.StringIO(text)) if row]


def _has_columns(table: Sequence[Sequence[str]], columns: Sequence[str]) -> bool:
    if not table:
        return False
    names = [name.strip().lower() for name in table[0]]
    return names == [name.lower() for name in columns]


def _session(wait_s: float) -> Session:
    from requests import Session
    from requests.adapters import HTTPAdapter
    from urllib3.util import Retry

    retry = Retry(
        total=6,
        connect=2,
        status_forcelist=_BUSY,
        backoff_factor=wait_s,
        raise_on_status=False,
        retry_after_max=_LONGEST_WAIT_S,
    )
    session = Session()
    session.mount("http://", HTTPAdapter(max_retries=retry))
    session.mount("https://", HTTPAdapter(max_retries=retry))
    session.headers["Accept"] = "text/csv"
    if os.environ.get(TOKEN):
        session.headers["X-App-Token"] = os.environ[TOKEN]
    return session


def _reason(error: BaseException) -> str:
    """Returns the innermost reason of an error of requests, without its objects' addresses."""
    inner: BaseException = error
    deeper: BaseException | None = error
    while deeper is not None:
        inner = deeper
        deeper = _cause(inner)
    text = " ".join(str(inner).split()) or type(inner).__name__
    return re.sub(r"^\w+\(.*?\): ", "", text)[:200]


def _cause(error: BaseException) -> BaseException | None:
    """Returns the error that another one carries; None if it carries none."""
    reason = getattr(error, "reason", None)
    if reason:
        if isinstance(reason, BaseException):
            return reason
        return None
    for argument in error.args:
        if isinstance(argument, BaseException):
            return argument
    return None


def _complaint(answer: Response) -> str:
    """Returns the status of a refusal, and the message that SODA sends along."""
    try:
        message = str(answer.json()["message"])
    except (ValueError, KeyError, TypeError):
        message = answer.reason or ""
    return " ".join(f"{answer.status_code} {message}".split())[:200]


@contextmanager
def _writing(folder: Path) -> Iterator[None]:
    """Makes the folder, and says in one sentence if it cannot be written."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield
    except OSError as error:
        raise OutputError(
            f"{error.filename or folder} cannot be written ({error.strerror or error});"
            " name another --folder"
        ) from error


@contextmanager
def _alone(kept: Path) -> Iterator[None]:
    """Keeps a second download of the same recording out."""
    kept.mkdir(exist_ok=True)
    try:
        with FileLock(kept / "lock", timeout=0):
            yield
    except Timeout:
        raise DataError(
            f"{kept}: another process is downloading the same recording; wait for it"
        ) from None
