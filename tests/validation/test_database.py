"""Databases of strangers: whole, stored and not computed, and within limits."""

import itertools
import sqlite3
from contextlib import closing

import pytest

from r3jax.validation import database
from r3jax.validation.database import check_database, query_database
from r3jax.validation.errors import ForeignFileError

ENDLESS = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT i FROM n"


def make(path, *statements):
    with closing(sqlite3.connect(path)) as connection:
        for statement in statements:
            connection.execute(statement)
        connection.commit()
    return path


@pytest.mark.parametrize("page", [512, 4096, 65536])
def test_a_database_is_as_long_as_it_says(tmp_path, page):
    path = tmp_path / "a.db"
    with closing(sqlite3.connect(path)) as connection:
        connection.execute(f"PRAGMA page_size = {page}")
        connection.execute("CREATE TABLE blobs (data BLOB)")
        connection.execute("INSERT INTO blobs VALUES (?)", (bytes(3 * page),))
        connection.commit()
    whole = path.read_bytes()
    check_database(path)
    for lost in (1, 1000, page, len(whole) - 100):
        path.write_bytes(whole[:-lost])
        with pytest.raises(ForeignFileError, match=f"{len(whole) - lost:,} of {len(whole):,} byt"):
            check_database(path)
    path.write_bytes(whole + bytes(page))  # room that the header does not count yet
    check_database(path)


@pytest.mark.parametrize(
    "statement",
    [
        f"CREATE VIEW Data AS {ENDLESS}",
        "CREATE TABLE Data (id INTEGER, image BLOB AS (zeroblob(900000000)))",
        "CREATE TABLE Data (id INTEGER, image BLOB AS (zeroblob(900000000)) STORED)",
        "CREATE VIRTUAL TABLE data USING fts5(image)",
    ],
)
def test_what_is_computed_is_not_read(tmp_path, statement):
    path = make(tmp_path / "a.db", "CREATE TABLE Node (id INTEGER)", statement)
    check_database(path, ("Node", "Link"))
    with pytest.raises(ForeignFileError, match="its `Data`"):
        check_database(path, ("Node", "Data"))


def test_triggers_indexes_and_names_like_that_are_no_reason(tmp_path):
    path = make(
        tmp_path / "a.db",
        "CREATE TABLE Data (id INTEGER, is_virtual INTEGER)",
        "CREATE INDEX by_id ON Data (id)",
        "CREATE TRIGGER checks BEFORE INSERT ON Data BEGIN SELECT RAISE(ABORT, 'no'); END",
    )
    check_database(path, ("Data",))


def test_a_query_ends(tmp_path, monkeypatch):
    path = make(
        tmp_path / "a.db", f"CREATE VIEW rows AS {ENDLESS}", f"CREATE VIEW one AS SELECT count(*) "
        f"FROM ({ENDLESS})", "CREATE VIEW large AS SELECT zeroblob(600000000)",
    )  # fmt: skip
    monkeypatch.setattr(database, "_MAX_ROWS", 1000)
    with pytest.raises(ForeignFileError, match="1,000"):
        query_database(path, "SELECT i FROM rows")
    with pytest.raises(sqlite3.Error, match="too big"):
        query_database(path, "SELECT * FROM large")
    clock = itertools.count(0.0, 50.0)
    monkeypatch.setattr(database.time, "monotonic", lambda: next(clock))
    with pytest.raises(sqlite3.Error, match="interrupted"):
        query_database(path, "SELECT * FROM one")
