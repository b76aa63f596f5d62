"""The client over real HTTP: each route, and refusals, which are the errors of this machine."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from client_fixtures import alone, soon  # noqa: F401 (fixtures)
from live_service import Live, live, serving  # noqa: F401 (a fixture)
from services import FAKE
from sweep_folders import make_sweep_folder
from test_service_downloads import FILM, make_finished

from policies.errors import CannotRunError, CheckpointError, EnvError, NotFoundError, SpecError
from tests.narrowing import present
from tune_jobs.client import Client, ConflictError, answers
from tune_jobs.service.http import models
from tune_jobs.service.jobs import Job
from tune_jobs.service.summaries import SweepSummary
from tune_jobs.sweeps import verbs

# ruff: noqa: F811 - fixtures are named as arguments

YAML = "env: CartPole-v1\nalgorithm: ppo\nspace: {lr: {loguniform: [1e-4, 1e-2]}}\nnum_samples: 3\n"


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    """A service with a sweep that has ended, for tests that only look."""
    with serving(tmp_path_factory.mktemp("client") / "sweeps") as made:
        make_finished(made.storage / "mine")
        yield made


@pytest.fixture
def looking(site: Live) -> Iterator[Client]:
    with Client(site.url) as made:
        yield made


@pytest.fixture
def client(live: Live) -> Iterator[Client]:
    with Client(live.url) as made:
        yield made


# -- looking


def test_what_is_told_of_a_sweep_is_what_its_folder_says(site: Live, looking: Client) -> None:
    folder = site.storage / "mine"
    assert looking.status("mine") == verbs.status(folder)
    assert looking.list_sweeps() == verbs.list_sweeps(site.storage)
    assert looking.records("mine") == verbs.trials(folder)
    assert looking.best("mine").checkpoint.trial_id == "t0003"
    assert looking.spec("mine") == verbs.status(folder).sweep.spec
    assert looking.sweep("mine").counts == {"completed": 4}
    assert [sweep.name for sweep in looking.sweeps(state="completed")] == ["mine"]
    assert list(looking.sweeps(state="running")) == []


def test_what_is_told_of_a_trial_is_what_its_folder_says(site: Live, looking: Client) -> None:
    folder = site.storage / "mine"
    by_score = [trial.score for trial in looking.trials("mine")]
    assert by_score == sorted(by_score, key=lambda score: -present(score))
    trial = looking.trial("mine", "t0002")
    assert trial.point == verbs.trials(folder)[2].point
    assert [item.iteration for item in looking.iterations("mine", "t0002", after=4)] == [5, 6]
    assert isinstance(looking.log("mine", "t0002", lines=5), str)
    curve = looking.curves("mine", points=3).trials["t0002"]
    assert (curve.iteration[0], curve.iteration[-1]) == (1, 6)
    assert looking.importance("mine") == verbs.importance(folder)
    assert looking.compare("mine", top=2) == verbs.compare(folder, top=2)
    settings = ["mine/t0000", "mine/t0002/"]
    found = looking.compare(settings, objective="area")
    assert found == verbs.compare(settings, objective="area", storage=site.storage)


def test_lists_are_read_to_their_last_page(looking: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tune_jobs.client.asking._PAGE", 1)
    assert len(list(looking.trials("mine", sort="index", order="asc"))) == 4
    assert len(looking.list_sweeps()) == 1


def test_who_asks_and_what_the_service_is_are_said(looking: Client) -> None:
    me = looking.me()
    assert (me.name, me.role) == ("local", "admin")
    assert present(me.num_cpus) >= 1
    assert looking.jobs() == looking.jobs("running", "waiting") == []
    with pytest.raises(NotFoundError, match="no job 7"):
        looking.job(7)


def test_models_have_the_fields_of_the_services() -> None:
    pairs: list[tuple[Any, Any]] = [
        (answers.Job, Job), (answers.Summary, SweepSummary), (answers.Curve, models.Curve),
        (answers.Curves, models.CurvesOfSweep), (answers.FileOfSweep, models.FileOfSweep),
        (answers.Submitted, models.Submitted), (answers.Planned, models.Planned),
    ]  # fmt: skip
    for own, theirs in pairs:
        assert own.model_fields.keys() == theirs.model_fields.keys()


def test_a_service_that_does_not_say_whether_a_sweep_runs_is_understood(site: Live) -> None:
    (found, *_) = site.get("/sweeps").json()["sweeps"]
    assert answers.Summary.model_validate(found | {"alive": True}).alive is True
    del found["alive"]
    assert answers.Summary.model_validate(found).alive is False


# -- changing


def test_a_sweep_is_submitted_from_a_mapping_a_file_and_a_preset(client: Client, live: Live, tmp_path: Path) -> None:
    made = client.submit(FAKE, name="mine", note="why", tags=["x"], priority=3)
    assert (made.sweep, made.job.state, made.job.priority) == ("mine", "waiting", 3)
    file = tmp_path / "some name.yaml"
    file.write_text(YAML)
    with pytest.raises(SpecError, match="'some name'"):
        client.submit(file)
    file = file.rename(tmp_path / "poles.yaml")
    assert [client.submit(file).sweep for _ in range(2)] == ["poles", "poles-2"]
    assert client.submit("cartpole-ppo", overrides=["num_samples=2"]).sweep == "cartpole-ppo"
    assert client.spec("cartpole-ppo")["num_samples"] == 2
    assert client.plan(file, overrides=["num_samples=5"]).plan["num_points"] == 5
    with pytest.raises(SpecError, match="no preset of that name"):
        client.submit("cartpole-pppo")


def test_a_sweep_is_changed_stopped_resumed_and_deleted(client: Client, live: Live) -> None:
    client.submit(FAKE, name="mine")
    assert client.change("mine", note="a", tags=["b"], priority=7).note == "a"
    assert client.job(1).priority == 7
    assert [job.id for job in client.jobs("waiting", "running")] == [1]
    assert client.jobs("ended") == client.jobs("running", "creating") == []
    assert [job.outcome for job in client.stop("mine")] == ["cancelled"]
    with pytest.raises(ConflictError, match="neither waits nor runs"):
        client.stop("mine")
    assert client.resume("mine").verb == "drive"
    with pytest.raises(ConflictError, match="waits or runs"):
        client.delete("mine", force=True)
    client.stop("mine")
    client.delete("mine", force=True)
    assert list(client.sweeps()) == []


def test_a_finished_sweep_is_extended_and_replicated(client: Client, live: Live) -> None:
    make_sweep_folder(live.storage / "done")
    assert client.extend("done", 3).arguments == {"to_num_samples": 5}
    assert client.inject("done", {"lr": 0.5}).arguments == {"point": {"lr": 0.5}}
    with pytest.raises(SpecError, match="gamma"):
        client.inject("done", {"gamma": 0.5})
    assert client.replicate("done", top=2, seeds=1).arguments == {"top": 2, "seeds": 1}
    with pytest.raises(ConflictError, match="no failed trial"):
        client.retry("done")


# -- files


def test_files_are_downloaded_whole_or_not_at_all(looking: Client, tmp_path: Path) -> None:
    paths = {file.path for file in looking.files("mine")}
    assert {"report/index.html", "films/after_mp4", "policy/policy.json"} <= paths
    to = looking.download("mine", "films/after_mp4", tmp_path / "new" / "film.mp4")
    assert to.read_bytes() == FILM
    for path in ("policy", "trials.csv", "trials/t0003/checkpoints/6"):
        assert looking.download("mine", path, tmp_path / "x").stat().st_size > 100
    with pytest.raises(NotFoundError, match="no file"):
        looking.download("mine", "report/none.html", tmp_path / "y")
    assert not list(tmp_path.glob("y*"))
    assert not list(tmp_path.glob(".*"))
    with pytest.raises(CannotRunError, match="is a folder"):
        looking.download("mine", "policy", tmp_path)


def test_a_download_goes_to_the_home_folder_and_to_no_url(
    looking: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    home, working = tmp_path / "home", tmp_path / "working"
    for folder in (home, working):
        folder.mkdir()
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.chdir(working)
    assert looking.download("mine", "films/after_mp4", "~/new/film.mp4") == home / "new" / "film.mp4"
    assert (home / "new" / "film.mp4").read_bytes() == FILM
    for url in ("s3://ann:s3cret@bucket/film.mp4", Path("s3://bucket/film.mp4")):
        with pytest.raises(SpecError, match="for what is written on this machine") as caught:
            looking.download("mine", "films/after_mp4", url)
        assert "s3cret" not in str(caught.value)
    assert list(working.iterdir()) == []


def test_no_folder_is_made_for_what_is_not_there(looking: Client, tmp_path: Path) -> None:
    for sweep, path in (("mine", "report/none.html"), ("none", "policy")):
        with pytest.raises(NotFoundError):
            looking.download(sweep, path, tmp_path / "new" / "file")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").write_text("")
    with pytest.raises(CannotRunError, match="file"):
        looking.download("mine", "policy", tmp_path / "file" / "policy.zip")


# -- refusals are the errors of this machine


def test_refusals_are_the_errors_of_this_machine(client: Client, live: Live) -> None:
    with pytest.raises(NotFoundError, match="no sweep 'none'") as missing:
        client.status("none")
    assert "tune-jobs list" in missing.value.hint
    with pytest.raises(SpecError, match="hiden_sizes") as wrong:
        client.submit(FAKE | {"space": {"hiden_sizes": [[1]]}})
    assert "tune-jobs schema" in wrong.value.hint
    with pytest.raises(EnvError, match="NoSuchEnv-v0"):
        client.plan(FAKE | {"env": "NoSuchEnv-v0"})
    with pytest.raises(SpecError, match="is no name of a sweep"):
        client.status("a/b")
    with pytest.raises(SpecError, match="is no id of a trial"):
        client.trial("a", "../b")
    (make_sweep_folder(live.storage / "bad").folder / "sweep.json").write_text("{")
    with pytest.raises(CheckpointError, match=r"sweep\.json"):
        client.status("bad")


def test_a_route_that_an_older_service_lacks_is_told(client: Client) -> None:
    with pytest.raises(CannotRunError, match=r"does not know GET /api/v1/sweeps/x/newer") as caught:
        client._ask("GET", "/sweeps/x/newer")
    assert "update the older one" in caught.value.hint


def test_numbers_that_json_lacks_arrive(client: Client, live: Live) -> None:
    store = make_sweep_folder(live.storage / "odd")
    record = store.trial("t0001").read_record()
    store.trial("t0001").write_record(record.model_copy(update={"time_s": float("nan")}))
    store.write_record(store.read_record().model_copy(update={"run_time_s": float("inf")}))
    assert client.status("odd").sweep.run_time_s == float("inf")
    assert repr(client.records("odd")[1].time_s) == "nan"
    assert json.loads(live.get("/sweeps/odd/records").text)[1]["time_s"] == "NaN"
