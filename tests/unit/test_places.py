"""Places of sweeps and storages: folders, and URLs of object stores."""

import dataclasses
import shlex
from pathlib import Path
from typing import cast

import pytest
from click.testing import CliRunner
from fake_sweeps import BEST, SWEEP, TRIALS, RunCommand, run  # noqa: F401 (a fixture)
from sweep_folders import make_sweep_folder

import tune_jobs
from analysis.wording import shown_part, shown_path
from policies.errors import SpecError
from tune_jobs.cli.commands import cli
from tune_jobs.cli.output import show_result, show_status
from tune_jobs.cli.remote import RemoteVerbs
from tune_jobs.client import Client
from tune_jobs.service.config import ServiceConfig
from tune_jobs.store.command_names import name_in_commands, served
from tune_jobs.store.opening import is_url, open_storage, open_sweep, sweep_of_trial
from tune_jobs.store.urls import join_place, name_of_place, outer_place
from tune_jobs.sweeps.create import CreatedSweep
from tune_jobs.sweeps.outcome import SweepResult
from tune_jobs.sweeps.plain import to_json
from tune_jobs.sweeps.status import SweepStatus
from tune_jobs.sweeps.storage import absolute_folder, local_path, place_named, split_trial, storage_place

# ruff: noqa: F811 - fixtures are named as arguments

SETTINGS = "?endpoint=http://host:9000"
VARIABLES = ("AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT_URL", "AWS_REGION", "AWS_DEFAULT_REGION", "TUNE_JOBS_STORAGE")


@pytest.fixture(autouse=True)
def no_variables(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in VARIABLES:
        monkeypatch.delenv(name, raising=False)


# -- places as texts


@pytest.mark.parametrize(
    ("place", "name", "joined"),
    [
        ("/sweeps", "mine", "/sweeps/mine"),
        ("file:///my%20sweeps", "mine", "/my sweeps/mine"),
        ("s3://bucket", "mine", "s3://bucket/mine"),
        ("s3://bucket/", "mine", "s3://bucket/mine"),
        ("s3://bucket/a/b", "mine", "s3://bucket/a/b/mine"),
        (f"s3://bucket/a{SETTINGS}", "mine", f"s3://bucket/a/mine{SETTINGS}"),
        (f"s3://bucket{SETTINGS}", "mine-2.x", f"s3://bucket/mine-2.x{SETTINGS}"),
        ("gs://bucket/a", "a b?", "gs://bucket/a/a%20b%3F"),
    ],
)
def test_a_name_is_joined_before_the_settings_and_is_found_again(place: str, name: str, joined: str) -> None:
    assert join_place(place, name) == joined
    assert name_of_place(joined) == name
    if not place.startswith("file:"):
        assert outer_place(joined) == place.replace("bucket/" if place.endswith("/") else "\0", "bucket")


def test_a_bucket_has_no_name_and_lies_in_itself() -> None:
    for place in ("s3://bucket", f"s3://bucket{SETTINGS}", "s3://bucket/"):
        assert name_of_place(place) == ""
        assert outer_place(place) == place


@pytest.mark.parametrize(
    ("place", "expected"),
    [
        ("s3://b/p", True), ("S3://b/p", True), ("gs://b", True), ("az://c/p", True), ("abfs://c@a/p", False),
        ("memory://x", False), ("file:///x", False), ("/s3://b", False), ("mine", False), ("s3:/b", False),
        (Path("s3://b"), False),
    ],
)  # fmt: skip
def test_only_an_object_store_is_a_url(place: str | Path, expected: bool) -> None:
    assert is_url(place) is expected


# -- what a user gives


@pytest.mark.parametrize(
    ("given", "place"),
    [
        ("s3://bucket/a/", "s3://bucket/a"),
        ("S3://bucket/a", "s3://bucket/a"),
        ("s3://bucket", "s3://bucket"),
        (f"s3://bucket/a/{SETTINGS}", f"s3://bucket/a{SETTINGS}"),
        ("s3://bucket/a?endpoint=http%3A%2F%2Fhost%3A9000", f"s3://bucket/a{SETTINGS}"),
        ("file:///my%20sweeps", "/my sweeps"),
        ("file://localhost/sweeps", "/sweeps"),
    ],
)
def test_a_url_has_one_form(given: str, place: str) -> None:
    assert storage_place(given) == place
    assert place_named(place) == place


def test_a_folder_is_absolute_and_the_variable_may_be_a_url(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", "/home/me")
    assert storage_place("~/mine") == "/home/me/mine"
    assert storage_place(Path("mine")) == str(tmp_path / "mine")
    monkeypatch.setenv("TUNE_JOBS_STORAGE", f"s3://bucket/a{SETTINGS}")
    assert storage_place(None) == f"s3://bucket/a{SETTINGS}"
    assert storage_place("mine") == str(tmp_path / "mine")


@pytest.mark.parametrize(
    ("variables", "given", "place"),
    [
        ({"AWS_ENDPOINT_URL": "http://a:1"}, "s3://b/p", "s3://b/p?endpoint=http://a:1"),
        (
            {"AWS_ENDPOINT_URL": "http://a:1", "AWS_ENDPOINT_URL_S3": "http://s:2"},
            "s3://b",
            "s3://b?endpoint=http://s:2",
        ),
        ({"AWS_ENDPOINT_URL": "http://a:1"}, f"s3://b/p{SETTINGS}", f"s3://b/p{SETTINGS}"),
        ({"AWS_REGION": "eu-1", "AWS_DEFAULT_REGION": "us-2"}, "s3://b/p", "s3://b/p?region=eu-1"),
        ({"AWS_DEFAULT_REGION": "us-2"}, "s3://b/p?region=x", "s3://b/p?region=x"),
        ({"AWS_DEFAULT_REGION": "us-2", "AWS_ENDPOINT_URL": "http://a:1"}, "gs://b/p", "gs://b/p"),
        ({"AWS_ENDPOINT_URL": ""}, "s3://b/p", "s3://b/p"),
    ],
)
def test_what_the_environment_says_of_the_store_is_set_once(
    monkeypatch: pytest.MonkeyPatch, variables: dict[str, str], given: str, place: str
) -> None:
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    assert storage_place(given) == place


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("ftp://host/p", r"ftp://: known are s3://, gs://, az://, file:// and folders"),
        ("http://host:9000/b", r"http://: known are s3://"),
        ("memory://b", r"memory://"),
        ("s3://", "names no bucket"),
        ("s3:///a", "names no bucket"),
        ("s3://?endpoint=http://a", "names no bucket"),
        ("s3://b/a//c", "empty part"),
        ("s3://b/../c", r"\.\."),
        ("file://host/x", "no folder of this machine"),
        ("s3:/b/p", "one slash"),
        (Path("s3://b/p"), "one slash"),
    ],
)
def test_a_url_that_no_sweeps_can_be_kept_at_is_refused(given: str | Path, message: str) -> None:
    with pytest.raises(SpecError, match=message):
        storage_place(given)


@pytest.mark.parametrize(
    "given",
    [
        "s3://key:hunter2@bucket/p", "s3://hunter2@bucket/p", "s3://key:hun/hunter2@bucket", "s3://key:hunter2/bucket",
        "s3://bucket/p?access_key=hunter2", "s3://bucket?aws_secret_access_key=hunter2", "gs://b?token=hunter2",
        "s3://bucket?endpoint=http://key:hunter2@host:9000", "az://c@a:hunter2/x", "az://c/x?sig=hunter2",
        "ftp://me:hunter2@host/p",
    ],
)  # fmt: skip
def test_credentials_in_a_url_are_refused_and_not_repeated(given: str) -> None:
    with pytest.raises(SpecError) as raised:
        storage_place(given)
    assert "hunter2" not in str(raised.value)


def test_credentials_in_an_endpoint_of_the_environment_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://key:hunter2@host:9000")
    with pytest.raises(SpecError, match=r"\$AWS_ENDPOINT_URL") as raised:
        storage_place("s3://bucket")
    assert "hunter2" not in str(raised.value)


@pytest.mark.parametrize(
    ("source", "parts"),
    [
        ("mine/t0003", ("mine", "t0003")),
        ("mine", ("", "")),
        (f"s3://b/mine/t0003{SETTINGS}", (f"s3://b/mine{SETTINGS}", "t0003")),
        ("s3://b", ("", "")),
    ],
)
def test_a_trial_is_named_behind_its_sweep(source: str, parts: tuple[str, str]) -> None:
    assert split_trial(source) == parts
    if parts[0]:
        assert shown_part(*parts) == source


# -- the settings of the default storage


@pytest.mark.parametrize(
    ("storage", "given", "place"),
    [
        (f"s3://bucket/sweeps{SETTINGS}", "s3://bucket/sweeps/mine", f"s3://bucket/sweeps/mine{SETTINGS}"),
        (f"S3://bucket{SETTINGS}", "s3://bucket/other/mine/", f"s3://bucket/other/mine{SETTINGS}"),
        ("az://c/p?account=me", "az://c/p/mine", "az://c/p/mine?account=me"),
        (f"s3://bucket/sweeps{SETTINGS}", "s3://bucket/mine?region=x", "s3://bucket/mine?region=x"),
        (f"s3://bucket/sweeps{SETTINGS}", "s3://Bucket/mine", "s3://Bucket/mine"),
        (f"s3://bucket/sweeps{SETTINGS}", "gs://bucket/mine", "gs://bucket/mine"),
        ("s3://bucket/sweeps", "s3://bucket/mine", "s3://bucket/mine"),
        ("sweeps", "s3://bucket/mine", "s3://bucket/mine"),
        (f"s3://other/sweeps{SETTINGS}&access_key=hunter2", "s3://bucket/mine", "s3://bucket/mine"),
    ],
)
def test_a_url_without_settings_takes_those_of_the_default_storage_in_its_bucket(
    monkeypatch: pytest.MonkeyPatch, storage: str, given: str, place: str
) -> None:
    monkeypatch.setenv("TUNE_JOBS_STORAGE", storage)
    assert place_named(given) == place
    assert place_named(place) == place


def test_they_precede_those_of_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://a:1")
    monkeypatch.setenv("AWS_REGION", "eu-1")
    monkeypatch.setenv("TUNE_JOBS_STORAGE", f"s3://bucket/sweeps{SETTINGS}")
    assert place_named("s3://bucket/sweeps/mine") == storage_place(None).replace("sweeps", "sweeps/mine")
    assert "endpoint=http://host:9000" in place_named("s3://bucket/sweeps/mine")


def test_credentials_in_the_default_storage_are_not_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TUNE_JOBS_STORAGE", f"s3://bucket/sweeps{SETTINGS}&access_key=hunter2")
    with pytest.raises(SpecError, match=r"\$TUNE_JOBS_STORAGE has credentials in its settings") as raised:
        place_named("s3://bucket/sweeps/mine")
    assert "hunter2" not in str(raised.value)


# -- what is written on this machine


@pytest.mark.parametrize(
    "words",
    [
        ("reproduce", "mine/t0001", "--out"),
        ("video", "random", "--env", "CartPole-v1", "--output"),
        ("export", "mine", "--out"),
        ("token", "list", "--folder"),
    ],
)
@pytest.mark.parametrize("url", ["s3://key:hunter2@b/p", "S3:/b/p", "file:///x", "gs://b"])
def test_no_url_becomes_a_folder_of_this_machine(
    run: RunCommand, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], url: str
) -> None:
    monkeypatch.setattr("tune_jobs.sweeps.reproduce._train_again", lambda *_: pytest.fail("it trains"))
    make_sweep_folder(tmp_path / "sweeps" / "mine")
    told = run(*words, url)
    assert told.exit_code == SpecError.exit_code, told.output
    assert "written on this machine" in told.stderr
    assert "hunter2" not in told.output
    assert [path.name for path in tmp_path.iterdir()] == ["sweeps"]


@pytest.mark.parametrize("url", ["s3://key:hunter2@b/p/", "s3:/b/p.mp4"])
def test_no_url_becomes_one_for_what_a_service_has(url: str) -> None:
    """Nothing is asked of the service before."""
    remote = RemoteVerbs(cast("Client", None))
    for call in (
        lambda: remote.report("mine", output=url),
        lambda: remote.video("mine", output=url),
        lambda: remote.export(["mine"], "sweep", output=url),
    ):
        with pytest.raises(SpecError, match="written on this machine"):
            call()


def test_a_comparison_is_written_to_no_url(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    make_sweep_folder(tmp_path / "mine")
    with pytest.raises(SpecError, match="written on this machine"):
        tune_jobs.compare([tmp_path / "mine/t0000", tmp_path / "mine/t0002"], html="s3://b/page.html")
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


def test_what_only_looks_like_a_url_is_a_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", "/home/me")
    given = ("./s3:/b", "s3-results", "a/s3://b", "~/films/")
    assert [str(local_path(path)) for path in given] == ["s3:/b", "s3-results", "a/s3:/b", "/home/me/films"]
    assert absolute_folder(Path("own")) == tmp_path / "own"
    assert absolute_folder(None) is None


# -- opened, and told


def test_a_folder_is_opened_by_its_url_or_its_path(tmp_path: Path) -> None:
    for place in (tmp_path, str(tmp_path), tmp_path.as_uri()):
        assert open_storage(place).place == str(tmp_path)
        assert open_sweep(place).place == str(tmp_path)
    assert sweep_of_trial(str(tmp_path / "mine" / "trials" / "t0000")) is None


def test_commands_that_are_told_find_the_sweep_from_where_they_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("TUNE_JOBS_STORAGE", raising=False)
    monkeypatch.chdir(tmp_path)
    assert name_in_commands(str(tmp_path / "sweeps" / "mine")) == "mine"
    assert name_in_commands(str(tmp_path / "other" / "mine")) == str(tmp_path / "other" / "mine")
    assert (
        name_in_commands(str(tmp_path.parent / "my sweeps" / "mine")) == f"'{tmp_path.parent / 'my sweeps' / 'mine'}'"
    )
    monkeypatch.setenv("TUNE_JOBS_STORAGE", "other")
    assert name_in_commands(str(tmp_path / "other" / "mine")) == "mine"
    assert name_in_commands(str(tmp_path / "sweeps" / "mine")) == str(tmp_path / "sweeps" / "mine")
    url = "s3://bucket/sweeps/mine?endpoint=http://localhost:9000"
    assert name_in_commands(url) == f"'{url}'"
    monkeypatch.setenv("TUNE_JOBS_STORAGE", "s3://bucket/sweeps?endpoint=http://localhost:9000")
    assert name_in_commands(url) == "mine"
    assert name_in_commands(str(tmp_path / "sweeps" / "mine")) == str(tmp_path / "sweeps" / "mine")


def test_a_service_names_the_sweeps_of_its_storage_by_their_names(tmp_path: Path) -> None:
    place = str(tmp_path / "mine")
    with served(str(tmp_path)):
        assert name_in_commands(place) == "mine"
        assert name_in_commands(str(tmp_path.parent / "mine")) == str(tmp_path.parent / "mine")
    assert name_in_commands(place) == place


def test_a_result_has_the_folder_of_a_sweep_that_has_one() -> None:
    assert CreatedSweep("mine", "/a/mine").folder == Path("/a/mine")
    assert SweepResult("/a/mine", SWEEP, []).folder == Path("/a/mine")
    for result in (CreatedSweep("mine", "s3://b/mine"), SweepResult("s3://b/mine", SWEEP, [])):
        with pytest.raises(SpecError, match=r"(?s)s3://b/mine.*`place`"):
            _ = result.folder
        assert "s3://b/mine" in result._repr_html_()
        assert "href" not in result._repr_html_()


def test_the_names_in_json_stay() -> None:
    assert to_json(CreatedSweep("mine", "/a/mine")) == {"name": "mine", "folder": "/a/mine"}
    told = to_json(SweepResult("s3://b/mine", SWEEP, []))
    assert told["folder"] == "s3://b/mine"
    assert "place" not in told


def test_a_command_that_is_told_can_be_pasted(capsys: pytest.CaptureFixture[str]) -> None:
    place = f"s3://b/mine{SETTINGS}&region=eu"
    show_result(SweepResult(place, SWEEP, TRIALS, BEST, interrupted=True), as_json=False)
    assert f"tune-jobs resume {shlex.quote(place)}\n" in capsys.readouterr().err
    status = SweepStatus(SWEEP.model_copy(update={"state": "interrupted"}), {}, alive=False, place=place)
    assert f"resume '{place}'` continues it" in status.facts()["time left"]
    at_service = dataclasses.replace(status, place=None)
    assert (
        f"`tune-jobs --server x resume {SWEEP.name}` continues" in at_service.facts("tune-jobs --server x")["time left"]
    )
    show_status(status, as_json=False)
    assert "resume 's3://b/mine?endpoint" in capsys.readouterr().out
    assert shown_path(place) == place


# -- a service whose sweeps are in an object store


def test_a_service_of_an_object_store_needs_a_folder_of_its_own(tmp_path: Path) -> None:
    config = ServiceConfig(storage="s3://b/p")
    with pytest.raises(SpecError, match=r"(?s)s3://b/p is no folder.*--folder"):
        _ = config.database_url
    given = ServiceConfig(storage="s3://b/p", own_folder=tmp_path)
    assert given.folder == given.working_folder == tmp_path
    assert str(tmp_path / "service.db") in given.database_url
    assert given.place == "s3://b/p"
    beside = ServiceConfig(storage=tmp_path / "sweeps")
    assert beside.working_folder == tmp_path / "sweeps"
    assert beside.folder == tmp_path / "sweeps" / ".service"


def test_tokens_are_in_the_folder_of_such_a_service(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    refused = CliRunner().invoke(cli, ["token", "list", "--storage", "s3://b/p"])
    assert refused.exit_code == SpecError.exit_code
    assert "--folder" in refused.output
    made = CliRunner().invoke(cli, ["token", "list", "--storage", "s3://b/p", "--folder", "own", "--json"])
    assert made.exit_code == 0, made.output
    assert (tmp_path / "own" / "service.db").is_file()
    assert not (tmp_path / "s3:").exists()


def test_a_url_is_opened_without_a_request_and_says_its_place() -> None:
    assert [open_it("s3://b/p").place for open_it in (open_storage, open_sweep)] == ["s3://b/p"] * 2
