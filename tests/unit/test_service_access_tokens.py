"""Tokens, how often something may be tried, the audit log, and the commands about them; over both databases."""

import hashlib
import json
import re
import typing
from collections.abc import Iterator
from pathlib import Path

import pytest
from databases import database_url, postgresql  # noqa: F401 (fixtures)
from fake_sweeps import RunCommand
from service_access import Clock, no_space_for_tokens
from sqlalchemy import Engine, select

from policies.errors import CannotRunError, NotFoundError, SpecError
from tune_jobs.cli.token_commands import ROLES
from tune_jobs.service.access.attempts import RateLimit
from tune_jobs.service.access.audit import Audit, Done
from tune_jobs.service.access.callers import Role
from tune_jobs.service.access.tokens import FRESH_S, Tokens
from tune_jobs.service.config import ServiceConfig
from tune_jobs.service.database.opening import open_database
from tune_jobs.service.database.tables import tokens as table
from tune_jobs.service.service import opened

# ruff: noqa: F811 - fixtures are named as arguments
DAY_S = 86_400.0


@pytest.fixture
def engine(database_url: str) -> Iterator[Engine]:
    made = open_database(database_url)
    yield made
    made.dispose()


# -- tokens


def test_a_token_is_known_by_its_hash_alone(engine: Engine) -> None:
    clock = Clock()
    tokens = Tokens(engine, clock)
    token, secret = tokens.make("ann@example.org", "submitter", 2.0)
    assert re.fullmatch(rf"tune-jobs_{token.id}_[\w-]{{43}}", secret)
    with engine.begin() as connection:
        row = connection.execute(select(table)).mappings().one()
    assert row["digest"] == hashlib.sha256(secret.encode()).hexdigest()
    assert secret.removeprefix(f"tune-jobs_{token.id}_") not in str(dict(row))
    assert (token.role, token.expires_at) == ("submitter", clock.s + 2 * DAY_S)
    assert tokens.make("ann@example.org", "submitter", 2.0)[1] != secret
    found = tokens.find(secret)
    assert found is not None
    assert found.caller.name == "ann@example.org"
    assert found.caller.token_id == token.id


def test_what_is_nearly_a_token_is_none(engine: Engine) -> None:
    tokens = Tokens(engine)
    secret, other = tokens.make("ann", "admin")[1], tokens.make("bob", "admin")[1]
    swapped = "_".join([*secret.split("_", 2)[:2], other.split("_", 2)[2]])
    for wrong in (
        "", "x", secret[:-1], secret + "a", secret.upper(), secret + "\n", " " + secret, swapped, secret[:-1] + "é",
        "\ud800", secret.replace("_", "-"), "tune-jobs_' OR 1=1 --_" + "a" * 43,
    ):  # fmt: skip
        assert tokens.find(wrong) is None, wrong
        assert tokens.remembered(wrong) is None


def test_secrets_are_compared_in_constant_time(engine: Engine, monkeypatch: pytest.MonkeyPatch) -> None:
    tokens = Tokens(engine)
    secret = tokens.make("ann", "admin")[1]
    compared: list[tuple[str, str]] = []

    def compare(one: str, other: str) -> bool:
        compared.append((one, other))
        return False

    monkeypatch.setattr("hmac.compare_digest", compare)
    for asked in (secret, "tune-jobs_00000000_" + "a" * 43):
        assert tokens.find(asked) is None
    # Also where there is no such token, or the time would tell which ids there are.
    assert len(compared) == 2
    assert {len(text) for pair in compared for text in pair} == {64}


def test_a_token_expires_and_is_revoked(engine: Engine) -> None:
    clock = Clock()
    tokens = Tokens(engine, clock)
    token, _ = tokens.make("ann", "viewer", 1.0)
    clock.s += 1
    _, long = tokens.make("bob", "viewer", 10.0)
    assert tokens.any_valid()
    clock.s += DAY_S - 1
    assert [item.state(clock.s) for item in tokens.all()] == ["expired", "valid"]
    assert tokens.any_valid()
    found = tokens.find(long)
    assert found is not None
    revoked = tokens.revoke(found.id)
    clock.s += 1
    assert tokens.revoke(found.id) == revoked
    assert [item.state(clock.s) for item in tokens.all()] == ["expired", "revoked"]
    assert not tokens.any_valid()
    assert tokens.all()[0].id == token.id
    with pytest.raises(NotFoundError, match="no token 'x'"):
        tokens.revoke("x")


def test_a_token_is_believed_for_a_moment_and_forgotten_with_its_row(engine: Engine) -> None:
    clock = Clock()
    tokens = Tokens(engine, clock)
    token, secret = tokens.make("ann", "viewer")
    assert tokens.remembered(secret) is None
    tokens.find(secret)
    known = tokens.remembered(secret)
    assert known is not None
    assert (known[0].id, known[1]) == (token.id, True)
    clock.s += FRESH_S
    known = tokens.remembered(secret)
    assert known is not None
    assert not known[1]
    with engine.begin() as connection:
        connection.execute(table.delete())
    assert tokens.find(secret) is None
    assert tokens.remembered(secret) is None


def test_the_last_use_is_noted_to_the_minute(engine: Engine) -> None:
    clock = Clock()
    tokens = Tokens(engine, clock)
    _, secret = tokens.make("ann", "viewer")
    first = clock.s
    for passed, noted in ((0, first), (59, first), (1, first + 60)):
        clock.s += passed
        tokens.find(secret)
        assert tokens.all()[0].last_used_at == noted


def test_a_token_is_found_where_its_use_can_not_be_noted(engine: Engine) -> None:
    tokens = Tokens(engine)
    token, secret = tokens.make("ann", "viewer")
    with no_space_for_tokens(engine) as refused:
        found = tokens.find(secret)
    assert len(refused) == 1
    assert found == token
    known = tokens.remembered(secret)
    assert known is not None
    assert known[1]
    tokens.find(secret)
    assert tokens.all()[0].last_used_at is not None


@pytest.mark.parametrize("name", ["", " ", "a b", "<b>", "a\nb", "a/b", "-a", "a" * 101, "local", "a\0", "'; --"])
def test_names_that_are_none(engine: Engine, name: str) -> None:
    with pytest.raises(SpecError, match="can't be the name of a token"):
        Tokens(engine).make(name, "viewer")


@pytest.mark.parametrize("days", [0.0, -1.0, 1e6, float("nan"), float("inf")])
def test_times_that_are_none(engine: Engine, days: float) -> None:
    with pytest.raises(SpecError, match="can't be valid for"):
        Tokens(engine).make("ann", "viewer", days)


# -- how often


def test_so_many_in_a_window_and_no_more() -> None:
    clock = Clock()
    limit = RateLimit(3, 60.0, clock)
    assert [limit.begin("a") for _ in range(3)] == [0, 0, 0]
    clock.s += 20
    assert limit.begin("a") == 40
    assert limit.begin("b") == 0
    limit.forgive("a")
    assert limit.begin("a") == 0
    clock.s += 40
    assert [limit.begin("a") for _ in range(3)] == [0, 0, 20]
    limit.forgive("nobody")


def test_those_who_came_long_ago_are_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(RateLimit, "MAX_KEYS", 3)
    limit = RateLimit(1, 60.0, Clock())
    for key in "abca":
        limit.begin(key)
    limit.begin("d")
    assert set(limit._attempts) == {"c", "a", "d"}
    assert limit.begin("a") > 0


# -- the audit log


def test_the_log_has_pages_and_is_filtered(engine: Engine) -> None:
    clock = Clock()
    log = Audit(engine, clock)
    for number in range(5):
        clock.s += 1
        log.write(Done("ann" if number % 2 else "bob", "192.0.2.1", "stop", f"s{number}", 202, {"token": "x"}))
    first, cursor = log.page(limit=2)
    assert [entry.target for entry in first] == ["s4", "s3"]
    # What comes in between moves no page.
    log.write(Done("ann", "", "stop", "s9", 202, {}))
    second, cursor = log.page(limit=2, cursor=cursor)
    third, end = log.page(limit=2, cursor=cursor)
    assert [entry.target for entry in second + third] == ["s2", "s1", "s0"]
    assert end is None
    assert [entry.target for entry in log.page(limit=9, who="ann")[0]] == ["s9", "s3", "s1"]
    assert [entry.who for entry in log.page(limit=9, target="s4")[0]] == ["bob"]
    assert log.page(limit=9, who="'; DROP TABLE audit; --") == ([], None)


@pytest.mark.parametrize("cursor", ["", "x", "-1", "1.5", "1" * 30, "²", "1 OR 1=1"])
def test_a_cursor_of_another_list_is_refused(engine: Engine, cursor: str) -> None:
    with pytest.raises(SpecError, match="cursor"):
        Audit(engine).page(limit=1, cursor=cursor)


def test_what_does_not_fit_is_cut(engine: Engine) -> None:
    log = Audit(engine)
    log.write(Done("w" * 500, "c" * 500, "a" * 500, "t\0\ud800" * 500, 200, {"path": "p" * 500}))
    entry = log.page(limit=1)[0][0]
    lengths = [len(text) for text in (entry.who, entry.client, entry.action, entry.target, entry.details["path"])]
    assert lengths == [100, 100, 50, 200, 200]


# -- commands


def test_tokens_are_made_listed_and_revoked_by_commands(run: RunCommand, tmp_path: Path) -> None:
    at = ["--storage", tmp_path / "sweeps"]
    made = run("token", "make", "ann", "--role", "submitter", "--days", 2, *at)
    assert made.exit_code == 0, made.output
    secret = made.stdout.strip()
    # The secret alone is on standard output, for a script to take.
    assert re.fullmatch(r"tune-jobs_[0-9a-f]{8}_[\w-]{43}", secret)
    assert "not shown again" in made.stderr
    listed = run("token", "list", *at)
    token_id = secret.split("_")[1]
    assert token_id in listed.stdout
    assert secret.split("_", 2)[2] not in listed.stdout
    (row,) = json.loads(run("token", "list", "--json", *at).stdout)
    assert (row["name"], row["role"], row["state"], row["last_used_at"]) == ("ann", "submitter", "valid", None)
    assert row["expires_at"] - row["created_at"] == 2 * DAY_S
    assert run("token", "revoke", token_id, *at).exit_code == 0
    assert json.loads(run("token", "list", "--json", *at).stdout)[0]["state"] == "revoked"
    with opened(ServiceConfig(storage=tmp_path / "sweeps", spare_idle_s=0)) as service:
        told = [(entry.who, entry.action, entry.details["token"]) for entry in service.gate.audit.page(limit=9)[0]]
    assert told == [("command line", "token revoke", token_id), ("command line", "token make", token_id)]


def test_commands_work_while_the_service_runs(run: RunCommand, tmp_path: Path) -> None:
    with opened(ServiceConfig(storage=tmp_path / "sweeps", spare_idle_s=0)) as service:
        secret = json.loads(
            run("token", "make", "ann", "--role", "viewer", "--json", "--storage", tmp_path / "sweeps").stdout
        )["token"]
        found = service.gate.tokens.find(secret)
    assert found is not None
    assert found.name == "ann"


def test_commands_take_another_database(run: RunCommand, tmp_path: Path, database_url: str) -> None:
    assert run("token", "make", "ann", "--role", "admin", "--database", database_url).exit_code == 0
    engine = open_database(database_url)
    assert Tokens(engine).any_valid()
    engine.dispose()


@pytest.fixture
def in_a_storage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TUNE_JOBS_STORAGE", str(tmp_path))


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        ("make ann", 2, "--role"), ("make ann --role boss", 2, "boss"), ("make <b> --role admin", 2, "'<b>'"),
        ("make ann --role admin --days 0", 2, "days"), ("make ann --role admin --days 1e9", 2, "1e+09 days"),
        ("revoke 12345678", 4, "tune-jobs token list"), ("list --database mysql://x/y", 5, "SQLite or PostgreSQL"),
        ("make ann --role admin --storage /proc/x", 5, "/proc/x"),
    ],
)  # fmt: skip
def test_commands_say_what_is_wrong(run: RunCommand, in_a_storage: None, arguments: str, code: int, said: str) -> None:
    result = run("token", *arguments.split())
    assert result.exit_code == code, result.output
    assert said in result.output


def test_there_are_no_tokens_at_first(run: RunCommand, tmp_path: Path) -> None:
    assert "no tokens here yet" in run("token", "list", "--storage", tmp_path).stdout


def test_the_command_knows_all_roles() -> None:
    assert typing.get_args(Role) == ROLES


# -- a service that nobody could use


@pytest.mark.parametrize("settings", [{"host": "0.0.0.0"}, {"require_token": True}, {"behind_proxy": "loopback"}])
def test_a_service_that_nobody_could_use_does_not_start(tmp_path: Path, settings: dict[str, typing.Any]) -> None:
    config = ServiceConfig(storage=tmp_path / "my sweeps", spare_idle_s=0, **settings)
    with pytest.raises(CannotRunError) as raised, opened(config):
        pass
    command = f"tune-jobs token make NAME --role admin --storage '{tmp_path}/my sweeps'"
    assert command in raised.value.hint
    engine = open_database(f"sqlite:///{config.folder / 'service.db'}")
    clock = Clock()
    Tokens(engine, clock).make("late", "admin", 1.0)  # long ago
    with pytest.raises(CannotRunError), opened(config):
        pass
    Tokens(engine).make("ann", "viewer")
    engine.dispose()
    with opened(config):
        pass
