"""Reading SQLite databases of strangers: plain tables only, and no more than fits.

A view, a virtual table or a generated column computes its rows while it is read: without end, or
900 MB each out of a file of 20 kB. So only stored data is read, and queries have limits.
"""

import sqlite3
import struct
import time
from collections.abc import Collection, Generator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import quote

from r3jax.validation.errors import ForeignFileError
from r3jax.validation.files import check_regular

_MAX_ROWS = 1_000_000
_MAX_VALUE = 512 << 20
"""Largest row [bytes], the columns that are not read included."""

_MAX_RESULT = 512 << 20
"""All texts and blobs of a query [bytes]."""

_MAX_SECONDS = 60.0
"""Of one query: a damaged file can lead in circles."""

_STEPS = 100_000
"""Instructions of SQLite between two looks at the clock."""


def check_database(path: str | Path, tables: Collection[str] = ()) -> None:
    """Refuses an SQLite database that is shorter than it declares, or that computes its content.

    SQLite itself may read missing pages as zeros, or not notice (its file format, 1.3: pages in
    the header, to be trusted where the version that wrote them is that of the last change).

    Args:
        path: the file.
        tables: those that will be read; what does not exist is not looked at.

    Raises:
        ForeignFileError: not a regular file, cut off, or one of the tables is none.
        sqlite3.Error: no database, or a damaged one.
        OSError: missing, or not permitted.
    """
    size = check_regular(path)
    with open(path, "rb") as file:
        header = file.read(100)
    if len(header) < 100 or not header.startswith(b"SQLite format 3\0"):
        return  # SQLite says what is wrong
    (page,) = struct.unpack_from(">H", header, 16)
    changes, pages = struct.unpack_from(">II", header, 24)
    (valid_for,) = struct.unpack_from(">I", header, 92)
    whole = pages * (1 << 16 if page == 1 else page)  # 65,536 does not fit into two bytes
    if valid_for == changes and size < whole:
        raise ForeignFileError(f"the database is cut off: {size:,} of {whole:,} bytes are there")
    if tables:
        with _opened(path) as connection:
            for table in tables:
                _check_table(connection, table)


def _check_table(connection: sqlite3.Connection, table: str) -> None:
    """Refuses a table that is a view, virtual, or has columns that are computed."""
    found = connection.execute(
        "SELECT type, sql LIKE '%VIRTUAL%' AND rootpage = 0 FROM sqlite_master "
        "WHERE name = ? COLLATE NOCASE AND type IN ('table', 'view')",
        (table,),
    ).fetchone()
    if found is None:
        return
    if found != ("table", 0):
        raise ForeignFileError(
            f"its `{table}` is a view or a virtual table, which is not read: copy what it shows "
            "into a table"
        )
    columns = connection.execute("SELECT name, hidden FROM pragma_table_xinfo(?)", (table,))
    for name, hidden in columns:
        if hidden:
            raise ForeignFileError(
                f"`{name!s:.80}` of its `{table}` is a generated column, which is not read: store "
                "its values"
            )


def query_database(path: str | Path, sql: str, values: Sequence[Any] = ()) -> list[Any]:
    """Reads all rows of a query, without writing, even while another program has it open.

    Raises:
        ForeignFileError: more rows or bytes than a capture has, or a query without an end.
        sqlite3.Error, UnicodeError, OverflowError: no database, damaged, or without such tables.
    """
    rows: list[Any] = []
    total = 0
    with _opened(path) as connection:
        for row in connection.execute(sql, values):
            rows.append(row)
            total += sum(len(value) for value in row if isinstance(value, bytes | str))
            if len(rows) > _MAX_ROWS or total > _MAX_RESULT:
                raise ForeignFileError(
                    f"a table has more than {_MAX_ROWS:,} rows or {_MAX_RESULT >> 20} MiB: it is "
                    "something else"
                )
    return rows


@contextmanager
def _opened(path: str | Path) -> Generator[sqlite3.Connection]:
    """Opens a database for reading, with limits on sizes and on time."""
    end = time.monotonic() + _MAX_SECONDS
    name = f"file:{quote(str(Path(path).absolute()))}?mode=ro&immutable=1"
    with closing(sqlite3.connect(name, uri=True)) as connection:
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _MAX_VALUE)
        connection.set_progress_handler(lambda: time.monotonic() > end, _STEPS)
        connection.execute("PRAGMA trusted_schema = OFF")
        yield connection
