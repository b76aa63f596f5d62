"""Webhooks and the command: what is told, signed, tried again, and not lost when the service is killed."""

import http.server
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest
from databases import database_url, postgresql  # noqa: F401 (fixtures)
from sqlalchemy import Engine, select
from sweep_folders import make_sweep_folder

from policies.errors import SpecError
from tune_jobs.service import telling
from tune_jobs.service.config import ServiceConfig
from tune_jobs.service.database.opening import open_database, sqlite_url
from tune_jobs.service.database.tables import messages
from tune_jobs.service.events import Watch
from tune_jobs.service.queue import Queue
from tune_jobs.service.statuses import Seen, Statuses
from tune_jobs.service.telling import COMMAND, WAITS_S, Teller, signature
from tune_jobs.store.opening import open_storage

# ruff: noqa: F811 - fixtures are named as arguments


@dataclass
class Receiver:
    """A web server that keeps what it is sent, and answers as it is told."""

    url: str = ""
    status: int = 200
    got: list[tuple[dict[str, str], dict[str, Any]]] = field(default_factory=list)


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    made = Receiver()

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            made.got.append(({name.lower(): text for name, text in self.headers.items()}, json.loads(body)))
            self.send_response(made.status)
            if made.status == 302:
                self.send_header("Location", "/elsewhere")
            self.end_headers()

        def log_message(self, *_: object) -> None:
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        made.url = f"http://127.0.0.1:{server.server_address[1]}/hook"
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield made
        server.shutdown()
        thread.join()


@pytest.fixture
def engine(database_url: str) -> Iterator[Engine]:
    made = open_database(database_url)
    yield made
    made.dispose()


class Clock:
    def __init__(self) -> None:
        self.at = 1_000_000.0

    def __call__(self) -> float:
        return self.at


def test_a_message_arrives_once_and_signed(engine: Engine, receiver: Receiver) -> None:
    clock = Clock()
    teller = Teller(engine, [receiver.url], secret="hush", now=clock)
    teller.tell("sweep.ended", {"sweep": "a"})
    assert teller.send_due() == 1
    assert teller.send_due() == 0
    ((headers, body),) = receiver.got
    assert body == {"type": "sweep.ended", "timestamp": 1_000_000.0, "data": {"sweep": "a"}}
    text = json.dumps(body, sort_keys=True)
    assert headers["webhook-timestamp"] == "1000000"
    assert headers["webhook-signature"] == signature("hush", headers["webhook-id"], 1_000_000, text)
    assert headers["webhook-signature"] != signature("other", headers["webhook-id"], 1_000_000, text)


def test_the_signature_is_that_of_standard_webhooks() -> None:
    # Computed by: printf 'msg_1.1614265330.{"test": 2432232314}' | openssl dgst -sha256 -hmac hush -binary | base64
    expected = "v1,+YPPaY07/dyiFf9LrP+CYAen5BByzlrSLlRvCF+1JOg="
    assert signature("hush", "msg_1", 1_614_265_330, '{"test": 2432232314}') == expected
    # "hush", as that standard writes secrets.
    assert signature("whsec_aHVzaA==", "msg_1", 1_614_265_330, '{"test": 2432232314}') == expected


def test_what_does_not_arrive_is_tried_again_later_and_given_up(engine: Engine, receiver: Receiver) -> None:
    clock = Clock()
    teller = Teller(engine, [receiver.url], now=clock)
    receiver.status = 500
    teller.tell("sweep.failed", {"sweep": "a"})
    for number, wait in enumerate(WAITS_S, start=1):
        assert teller.send_due() == 0
        assert len(receiver.got) == number
        clock.at += wait - 1.0
        teller.send_due()
        assert len(receiver.got) == number, "too early"
        clock.at += 1.0
    teller.send_due()
    clock.at += 10**5
    teller.send_due()
    assert len(receiver.got) == len(WAITS_S) + 1
    assert len({headers["webhook-id"] for headers, _ in receiver.got}) == 1
    with engine.begin() as connection:
        assert connection.execute(select(messages.c.error)).scalar() == "it answered 500"


def test_a_receiver_that_recovers_gets_it(engine: Engine, receiver: Receiver) -> None:
    clock = Clock()
    teller = Teller(engine, ["http://127.0.0.1:9/none", receiver.url], now=clock)
    receiver.status = 302
    teller.tell("sweep.best", {"sweep": "a"})
    assert teller.send_due() == 0
    receiver.status = 204
    clock.at += WAITS_S[0]
    assert teller.send_due() == 1


def test_what_a_killed_service_has_not_sent_is_sent_by_the_next(engine: Engine, receiver: Receiver) -> None:
    Teller(engine, [receiver.url]).tell("sweep.ended", {"sweep": "a"})
    assert receiver.got == []
    assert Teller(engine, [receiver.url]).send_due() == 1


def test_nobody_is_told_whom_the_operator_no_longer_names(engine: Engine, receiver: Receiver) -> None:
    Teller(engine, [receiver.url]).tell("sweep.ended", {"sweep": "a"})
    assert Teller(engine, ["http://127.0.0.1:9/other"]).send_due() == 0
    assert receiver.got == []


def test_a_command_gets_the_message_as_its_input(engine: Engine, tmp_path: Path) -> None:
    code = "import os, sys; open(sys.argv[1], 'w').write(os.environ['TUNE_JOBS_EVENT'] + sys.stdin.read())"
    teller = Teller(engine, [COMMAND + json.dumps([sys.executable, "-c", code, str(tmp_path / "got")])])
    teller.tell("sweep.stuck", {"sweep": "$(touch x); `id`"})
    assert teller.send_due() == 1
    event, text = (tmp_path / "got").read_text().split("{", 1)
    assert event == "sweep.stuck"
    assert json.loads("{" + text)["data"] == {"sweep": "$(touch x); `id`"}


@pytest.mark.parametrize(("command", "told"), [
    ([sys.executable, "-c", "import sys; sys.exit('no luck')"], "exit code 1: no luck"),
    (["/nonexistent"], "No such file"),
])  # fmt: skip
def test_a_command_that_fails_is_tried_again(engine: Engine, command: list[str], told: str) -> None:
    teller = Teller(engine, [COMMAND + json.dumps(command)])
    teller.tell("sweep.ended", {})
    assert teller.send_due() == 0
    with engine.begin() as connection:
        row = connection.execute(select(messages)).mappings().one()
    assert told in row["error"]
    assert row["next_at"] is not None


def told_to(engine: Engine, script: str, *arguments: Path) -> tuple[int, str | None]:
    """Have a script of sh told something; return how many messages arrived, and the error that is kept."""
    teller = Teller(engine, [COMMAND + json.dumps(["sh", "-c", script, "sh", *map(str, arguments)])])
    teller.tell("sweep.ended", {"sweep": "a"})
    arrived = teller.send_due()
    with engine.begin() as connection:
        return arrived, connection.execute(select(messages.c.error)).scalar_one()


def runs(process_id: int) -> bool:
    """Whether a process is there that has not ended: where nobody takes its end, a killed one stays a zombie."""
    try:
        return Path(f"/proc/{process_id}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def test_what_a_command_leaves_in_the_background_neither_holds_its_message_nor_is_ended(
    engine: Engine, tmp_path: Path
) -> None:
    began = time.monotonic()
    # With the command's input and outputs: without `<&3` a shell gives it /dev/null.
    arrived = told_to(engine, 'exec 3<&0; sleep 90 <&3 & echo $! > "$1"; exit 0', tmp_path / "id")
    left = int((tmp_path / "id").read_text())
    try:
        assert arrived == (1, None)
        assert time.monotonic() - began < 20.0
        assert runs(left)
    finally:
        os.kill(left, signal.SIGKILL)


def test_a_command_that_takes_too_long_is_ended_with_what_it_began(
    engine: Engine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(telling, "_COMMAND_TIMEOUT_S", 2.0)
    error = told_to(engine, 'sleep 90 & echo $! $$ > "$1"; wait', tmp_path / "ids")
    inner, own = map(int, (tmp_path / "ids").read_text().split())
    try:
        assert error == (0, "it took longer than 2 s")
        until = time.monotonic() + 10.0
        while runs(inner) and time.monotonic() < until:
            time.sleep(0.05)
        assert not runs(inner)
        assert not runs(own)
    finally:
        if runs(inner):
            os.kill(inner, signal.SIGKILL)


def test_of_what_a_failed_command_says_the_end_is_kept(engine: Engine) -> None:
    arrived, error = told_to(engine, "yes 'line after line' | head -500 >&2; echo 'the end é' >&2; exit 3")
    assert arrived == 0
    assert error is not None
    assert error.startswith("exit code 3: ")
    assert error.endswith("line after line\nthe end é")
    assert len(error) == len("exit code 3: ") + 300


def test_a_message_that_can_not_even_be_made_keeps_no_other_from_being_told(
    engine: Engine, receiver: Receiver, tmp_path: Path
) -> None:
    code = "import sys; open(sys.argv[1], 'w').write(sys.stdin.read())"
    told = COMMAND + json.dumps([sys.executable, "-c", code, str(tmp_path / "got")])
    odd = COMMAND + json.dumps(["/bin/true", "\0"])
    clock = Clock()
    teller = Teller(engine, [receiver.url, odd, told], secret="whsec_no base64", now=clock)
    teller.tell("sweep.ended", {"sweep": "a"})
    assert teller.send_due() == 1
    assert (tmp_path / "got").exists()
    with engine.begin() as connection:
        rows = {row["target"]: row for row in connection.execute(select(messages)).mappings()}
    assert rows[receiver.url]["error"].startswith("unexpected Error: ")
    assert rows[odd]["error"] == "unexpected ValueError: embedded null byte"
    for target in (receiver.url, odd):
        assert (rows[target]["num_attempts"], rows[target]["next_at"]) == (1, clock.at + WAITS_S[0])


@pytest.mark.parametrize("secret", ["whsec_not base64!", "whsec_aHVzaA", "whsec_", "whsec_häsh", "h\udcffsh"])
def test_a_secret_that_signs_nothing_is_refused_and_not_repeated(secret: str, tmp_path: Path) -> None:
    with pytest.raises(SpecError, match="TUNE_JOBS_WEBHOOK_SECRET") as refused:
        ServiceConfig(storage=tmp_path, webhook_secret=secret)
    assert secret.removeprefix("whsec_") == "" or secret.removeprefix("whsec_") not in str(refused.value)
    assert ServiceConfig(storage=tmp_path, webhook_secret="whsec_aHVzaA==").webhook_secret == "whsec_aHVzaA=="


@pytest.mark.parametrize("url", ["", "file:///etc/passwd", "ftp://x", "javascript:x", "https://" + "x" * 3_000])
def test_what_is_no_webhook_is_refused(url: str, tmp_path: Path) -> None:
    with pytest.raises(SpecError, match="no URL of a webhook"):
        ServiceConfig(storage=tmp_path, webhooks=(url,))


# -- what is told


class Notes:
    """Keeps what is told."""

    def __init__(self) -> None:
        self.told: list[tuple[str, dict[str, Any]]] = []

    def tell(self, event: str, body: dict[str, Any]) -> None:
        self.told.append((event, body))

    def events(self) -> list[str]:
        return [event for event, _ in self.told]


class Looked(Statuses):
    """The statuses of a storage, with numbers that a test changes."""

    score: float | None = None
    steps = 100

    def see(self, name: str) -> Seen:
        seen = super().see(name)
        best = None if self.score is None or seen.status.best is None else replace(seen.status.best, score=self.score)
        sweep = seen.status.sweep.model_copy(update={"state": "running"})
        return replace(seen, status=replace(seen.status, sweep=sweep, best=best, num_env_steps=self.steps))


@pytest.fixture
def watched(tmp_path: Path) -> Iterator[tuple[Watch, Looked, Notes, Queue, Clock]]:
    made = open_database(sqlite_url(tmp_path / "service.db"))
    make_sweep_folder(tmp_path / "sweeps" / "a")
    queue, statuses, notes, clock = Queue(made), Looked(open_storage(tmp_path / "sweeps")), Notes(), Clock()
    queue.begin("a", "drive", {}, owner="ann")
    queue.claim(1.0)
    yield Watch(queue, statuses, notes, stuck_s=900.0, now=clock), statuses, notes, queue, clock  # type: ignore[arg-type]
    made.dispose()


def test_a_new_best_is_told_and_what_was_there_is_not(watched: tuple[Watch, Looked, Notes, Queue, Clock]) -> None:
    watch, statuses, notes, _, _ = watched
    for score, num_told in ((None, 0), (10.0, 1), (10.0, 1), (9.0, 1), (12.0, 2)):
        statuses.score = score
        watch.look()
        assert notes.events() == ["sweep.best"] * num_told
    assert notes.told[-1][1]["best"]["score"] == 12.0


def test_a_sweep_that_stands_still_is_told_once(watched: tuple[Watch, Looked, Notes, Queue, Clock]) -> None:
    watch, statuses, notes, _, clock = watched
    watch.look()
    for _ in range(3):
        clock.at += 450.0
        watch.look()
    assert notes.events() == ["sweep.stuck"]
    assert notes.told[0][1]["no_env_step_for_s"] == 900
    statuses.steps += 1
    watch.look()
    clock.at += 899.0
    watch.look()
    assert len(notes.told) == 1
    clock.at += 1.0
    watch.look()
    assert notes.events() == ["sweep.stuck"] * 2


def test_ends_are_told_with_the_job_and_the_sweep(watched: tuple[Watch, Looked, Notes, Queue, Clock]) -> None:
    watch, _, notes, queue, _ = watched
    job = queue.jobs()[0]
    for outcome in ("completed", "failed", "stopped", "cancelled"):
        watch.ended(job.model_copy(update={"outcome": outcome}))
    assert notes.events() == ["sweep.ended", "sweep.failed", "sweep.stopped"]
    assert notes.told[0][1]["job"]["outcome"] == "completed"
    assert notes.told[0][1]["counts"] == {"completed": 4}
    watch.ended(job.model_copy(update={"outcome": "failed", "sweep": "gone"}))
    assert "no sweep 'gone'" in notes.told[-1][1]["problem"]
