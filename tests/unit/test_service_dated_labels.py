"""Labels that an earlier version wrote, which don't say of which sweep of their names: a start finds it out, once."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import text
from sweep_folders import make_sweep_folder
from test_service_reused_names import MINE, NOTHING, as_, folder_of, make_anew, said, submitted

from policies.errors import CannotRunError, CheckpointError, TuneJobsError
from tune_jobs.service.config import ServiceConfig
from tune_jobs.service.database.opening import sqlite_url
from tune_jobs.service.http.app import make_app
from tune_jobs.service.labels import Label, date_labels
from tune_jobs.service.service import Service, opened
from tune_jobs.store.sweep_store import SweepStore


class Life:
    """The lives of a service over one folder and one database."""

    def __init__(self, folder: Path) -> None:
        self.config = ServiceConfig(folder / "sweeps", database=sqlite_url(folder / "service.db"), spare_idle_s=0.0)

    @contextmanager
    def begun(self) -> Iterator[Service]:
        with opened(self.config) as service:
            service.supervisor.close()
            yield service


@pytest.fixture
def life(tmp_path: Path) -> Life:
    """A service that ended; ann's sweep is in its database as an earlier version wrote it."""
    made = Life(tmp_path)
    with made.begun() as service:
        submitted(service)
        undate(service)
    return made


def undate(service: Service) -> None:
    with service.engine.begin() as connection:
        connection.execute(text("UPDATE sweeps SET created_at = NULL"))


def label(service: Service) -> Label:
    return service.labels.of("mine")


def shown(service: Service) -> tuple[Any, ...]:
    client = TestClient(make_app(service), base_url="http://127.0.0.1:8265", raise_server_exceptions=False)
    return said(client.get(MINE).json())


def test_a_label_is_of_the_sweep_that_has_its_name_at_the_next_start(life: Life) -> None:
    with life.begun() as service:
        assert label(service).created_at == service.storage.sweep("mine").read_record().created_at
        assert shown(service)[:3] == ("ann", "for the paper", ["paper"])
        make_anew(service)
        assert shown(service) == NOTHING
        assert as_("ann", service).delete(MINE, params={"force": True}).status_code == 403
        assert folder_of(service).exists()


def test_a_label_of_a_sweep_that_is_another_one_by_then_is_forgotten(life: Life) -> None:
    make_anew_while_down(life)
    with life.begun() as service:
        assert label(service) == Label()
        assert shown(service) == NOTHING
        assert as_("ann", service).patch(MINE, json={"note": "mine"}).status_code == 403


def make_anew_while_down(life: Life) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tune_jobs.service.service.date_labels", lambda *_: None)
        with life.begun() as service:
            make_anew(service)
            assert label(service).owner == "ann"


def test_a_job_of_the_new_sweep_makes_it_not_the_former_ones(life: Life) -> None:
    """Such as one that the start before has begun, where the new one had not been run."""
    make_anew_while_down(life)
    with life.begun() as service:
        service.labels.change("mine", owner="ann")
        service.queue.begin("mine", "drive", {}, owner="")
        date_labels(service.labels, service.queue, service.storage)
        assert label(service) == Label()


def test_a_sweep_that_was_submitted_after_one_of_its_name_is_whose_it_is(life: Life) -> None:
    with life.begun() as service:
        shutil.rmtree(folder_of(service))
        submitted(service, "bob")
        undate(service)
    with life.begun() as service:
        assert label(service).owner == "bob"
        assert label(service).created_at == service.storage.sweep("mine").read_record().created_at


def test_a_label_without_any_job_is_of_the_sweep_that_has_its_name(life: Life) -> None:
    with life.begun() as service:
        make_sweep_folder(Path(service.config.storage) / "other")
        service.labels.change("other", note="a terminal's")
    with life.begun() as service:
        assert service.labels.of("other") == Label(note="a terminal's", created_at=0.0)


@pytest.mark.parametrize("error", [CheckpointError("It is damaged."), CannotRunError("It is away.")])
def test_what_cannot_be_read_is_left_for_the_next_start(life: Life, error: TuneJobsError) -> None:
    def fail(_: SweepStore) -> None:
        raise error

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SweepStore, "read_record", fail)
        with life.begun() as service:
            assert (label(service).owner, label(service).created_at) == ("ann", None)
    with life.begun() as service:
        assert label(service).created_at is not None


def test_a_store_that_is_away_is_asked_once(life: Life, monkeypatch: pytest.MonkeyPatch) -> None:
    with life.begun() as service:
        for name in ("a", "b"):
            service.labels.change(name, owner="ann")
        asked: list[SweepStore] = []

        def away(store: SweepStore) -> None:
            asked.append(store)
            raise CannotRunError("It is away.")

        monkeypatch.setattr(SweepStore, "read_record", away)
        monkeypatch.setattr("tune_jobs.service.labels.is_of_store", lambda *_: True)
        date_labels(service.labels, service.queue, service.storage)
        assert len(asked) == 1


def test_where_all_labels_are_dated_no_sweep_is_read(life: Life, monkeypatch: pytest.MonkeyPatch) -> None:
    with life.begun() as service:
        read: list[SweepStore] = []
        monkeypatch.setattr(SweepStore, "read_record", read.append)
        date_labels(service.labels, service.queue, service.storage)
        assert (read, label(service).created_at is not None) == ([], True)
