"""The command line with --server: what is printed is what is printed on the service's machine; what is refused."""

import json
import re
from collections.abc import Iterator
from http import HTTPStatus
from pathlib import Path
from typing import Any, get_args

import click
import httpx2
import pytest
from client_fixtures import alone, soon  # noqa: F401 (fixtures)
from fake_results import COMPARISON, IMPORTANCE
from fake_sweeps import RunCommand
from live_service import Live, live, serving, wait_until  # noqa: F401 (a fixture)
from sweep_folders import make_sweep_folder
from test_service_downloads import FILM, PAGE, make_finished

from analysis.records import JobRecord
from tests.narrowing import present
from tune_jobs.cli.commands import cli
from tune_jobs.cli.server import THERE
from tune_jobs.client import Client
from tune_jobs.client.answers import FileOfSweep, Planned
from tune_jobs.store.names import FILMS
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps.outcome import Film

GUIDE = (Path(__file__).parents[2] / "docs" / "guides" / "service.md").read_text()
YAML = "env: CartPole-v1\nalgorithm: ppo\nspace: {lr: {loguniform: [1e-4, 1e-2]}}\nnum_samples: 3\nconfirm: none\n"


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    """A service with sweeps that have ended, failed, and were interrupted, for tests that only look."""
    with serving(tmp_path_factory.mktemp("commands") / "sweeps") as made:
        make_finished(made.storage / "mine")
        failed = make_sweep_folder(
            made.storage / "failed", space={"lr": {"uniform": [0.1, 0.2]}, "gamma": {"grid": [0.9, 0.99]}}
        )
        trial = failed.trial("t0001")
        changes = {"status": "failed", "error": "ValueError: [bold]é\u2028 broke", "time_s": float("nan")}
        trial.write_record(trial.read_record().model_copy(update=changes))
        stopped = make_sweep_folder(made.storage / "stopped")
        trial = stopped.trial("t0003")
        trial.write_record(trial.read_record().model_copy(update={"status": "paused", "num_env_steps": 3}))
        stopped.write_record(stopped.read_record().model_copy(update={"state": "interrupted", "run_time_s": 71.5}))
        yield made


# -- the same output


@pytest.mark.parametrize("json_option", [(), ("--json",)], ids=["text", "json"])
@pytest.mark.parametrize(
    "arguments",
    [
        "list", "status mine", "status failed", "status stopped", "trials mine", "trials failed", "trials stopped",
        "trials mine --sort lr", "trials failed --top 2", "trials mine --sort none", "best mine", "best none",
        "status none", "trials none", "stop mine", "importance mine", "importance failed", "importance stopped",
        "importance none", "compare mine failed", "compare mine", "compare mine/t0001 mine/t0003 stopped",
        "compare failed/t0000 mine --objective best", "compare mine --top 2", "compare mine/t0001", "compare mine mine",
        "compare stopped mine/t0099", "compare mine none", "compare mine/t0001 mine/t0000",
    ],
)  # fmt: skip
def test_what_is_printed_is_what_is_printed_there(
    run: RunCommand, site: Live, arguments: str, json_option: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = (*arguments.split(), *json_option)
    if "best mine" in arguments:
        # It would evaluate there, and has been evaluated.
        best = SweepStore(site.storage / "mine").read_best()
        monkeypatch.setattr("tune_jobs.sweeps.verbs.best", lambda *_, **__: best)
    monkeypatch.setenv("TUNE_JOBS_STORAGE", str(site.storage))
    here = run(*words)
    monkeypatch.delenv("TUNE_JOBS_STORAGE")
    monkeypatch.setenv("TUNE_JOBS_SERVER", site.url)
    there = run(*words)
    assert there.exit_code == here.exit_code
    if arguments.endswith(" none") and "sort" not in arguments:
        # There is another sentence about where it was looked for.
        assert "none" in there.stderr
        assert here.stderr.splitlines()[-1] == there.stderr.splitlines()[-1] or here.exit_code == 4
    else:
        assert there.stdout == here.stdout
        assert there.stderr == here.stderr
    monkeypatch.delenv("TUNE_JOBS_SERVER")
    # Longer commands in hints make wider columns.
    by_option = run("--server", site.url, *words).stdout.replace(f" --server {site.url}", "")
    assert re.sub(" +\n", "\n", by_option) == re.sub(" +\n", "\n", there.stdout)


def test_numbers_that_json_lacks_are_printed_as_there(
    run: RunCommand, site: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    for verb, derived, answer in (("importance", "importance", IMPORTANCE), ("compare", "compared", COMPARISON)):
        monkeypatch.setattr(site.service.derived, derived, lambda *_, answer=answer: answer)
        monkeypatch.setattr(f"tune_jobs.sweeps.verbs.{verb}", lambda *_, answer=answer, **__: answer)
        for words in ((verb, "mine"), (verb, "mine", "--json")):
            here, there = run(*words), run("--server", site.url, *words)
            assert here.exit_code == 0
            assert there.output == here.output
    with Client(site.url) as client:
        assert client.compare(["mine", "failed"]) == COMPARISON
        assert repr(client.importance("mine")) == repr(IMPORTANCE)


def test_commands_in_hints_go_to_the_same_service(run: RunCommand, site: Live) -> None:
    printed = run("--server", site.url, "status", "stopped").stdout
    assert f"`tune-jobs --server {site.url} resume stopped` continues it" in printed


def test_a_cluster_is_not_asked_for_the_job_of_a_services_sweep(
    run: RunCommand, site: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = make_sweep_folder(site.storage / "by-job")
    job = JobRecord(id="by-job-1", address="http://head:8265")
    store.write_record(store.read_record().model_copy(update={"job": job, "state": "interrupted"}))
    monkeypatch.setattr("tune_jobs.sweeps.detached.job_now", lambda *_: pytest.fail("the cluster was asked"))
    told = run("--server", site.url, "status", "by-job")
    assert told.exit_code == 0, told.output
    assert f"`tune-jobs --server {site.url} resume by-job` continues it" in told.stdout


def test_a_plan_is_the_services(run: RunCommand, site: Live, tmp_path: Path) -> None:
    (tmp_path / "poles.yaml").write_text(YAML)
    here = run("launch", "poles.yaml", "--dry-run", "--set", "num_samples=2", "--name", "x")
    there = run("--server", site.url, "launch", "poles.yaml", "--dry-run", "--set", "num_samples=2", "--name", "x")
    assert here.exit_code == there.exit_code == 0, there.stderr

    def plain(text: str) -> str:
        # Env steps take another time at each measurement, and the machine is told otherwise.
        return re.sub(r"[\d.]+ us per step|this machine|the service's machine|[─ -]+\n", "", text)

    assert plain(there.stdout) == plain(here.stdout)
    assert "the service's machine has" in there.stdout
    document = json.loads(run("--server", site.url, "launch", "poles.yaml", "--dry-run", "--json").stdout)
    assert document["plan"]["num_trials"] == 3
    wrong = run("--server", site.url, "launch", "poles.yaml", "--dry-run", "--set", "space.hiden_sizes=[[1]]")
    assert wrong.exit_code == 2
    assert "poles.yaml: 2 problems" in wrong.stderr
    assert "(from --set)" in wrong.stderr


def test_a_plan_of_a_newer_service_is_not_the_files_fault(
    run: RunCommand, site: Live, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "poles.yaml").write_text(YAML)
    plan = Client.plan

    def newer(self: Client, *args: Any, **options: Any) -> Planned:
        found = plan(self, *args, **options)
        return found.model_copy(update={"spec": found.spec | {"mood": "good"}})

    monkeypatch.setattr(Client, "plan", newer)
    told = run("--server", site.url, "launch", "poles.yaml", "--dry-run")
    assert told.exit_code == 5
    assert f"The service at {site.url} answers what this tune-jobs does not know: mood: there is no" in told.stderr
    assert "update the older one of the two" in told.stderr
    assert "SweepSpec" not in told.stderr


# -- files


def test_report_and_films_are_downloaded(run: RunCommand, site: Live, tmp_path: Path) -> None:
    assert "mine-report.html" in run("--server", site.url, "report", "mine").stdout
    assert (tmp_path / "mine-report.html").read_text() == PAGE
    run("--server", site.url, "report", "mine", "-o", "new/")
    assert (tmp_path / "new" / "mine-report.html").read_text() == PAGE
    run("--server", site.url, "report", "mine", "-o", "page.html")
    assert (tmp_path / "page.html").read_text() == PAGE
    printed = json.loads(run("--server", site.url, "video", "mine", "--json").stdout)
    assert printed.keys() == {"before_mp4", "after_mp4", "after_gif", "before_after_mp4"}
    assert (tmp_path / "mine-before_after.mp4").read_bytes() == FILM
    assert json.loads(run("--server", site.url, "video", "mine", "-o", "my/film.mp4", "--json").stdout) == {
        "mp4": "my/film.mp4", "gif": "my/film.gif",
    }  # fmt: skip
    for words, code in (("report failed", 4), ("video failed", 4), ("video mine/t0001", 2)):
        assert run("--server", site.url, *words.split()).exit_code == code


@pytest.mark.parametrize(
    ("output", "stem"), [("best-lr0.5", "best-lr0.5"), ("a.v1.gif", "a.v1"), ("my/film.MP4", "my/film")]
)
def test_a_film_keeps_its_name_behind_a_dot(
    run: RunCommand, site: Live, tmp_path: Path, output: str, stem: str
) -> None:
    printed = json.loads(run("--server", site.url, "video", "mine", "-o", output, "--json").stdout)
    assert printed == {"mp4": f"{stem}.mp4", "gif": f"{stem}.gif"}
    assert (tmp_path / f"{stem}.mp4").read_bytes() == FILM


def test_films_of_other_names_are_not_downloaded(
    run: RunCommand, site: Live, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = Client.files

    def more(client: Client, name: str) -> list[FileOfSweep]:
        odd = {"num_bytes": 1, "modified_at": 0.0, "media_type": "video/mp4"}
        names = ("films/../../../out", "films/after_mp4/../../../../x_mp4", "films//etc/x_mp4")
        return [*(FileOfSweep(path=path, **odd) for path in names), *files(client, name)]

    monkeypatch.setattr(Client, "files", more)
    printed = json.loads(run("--server", site.url, "video", "mine", "--json").stdout)
    assert tuple(printed) == get_args(Film) == tuple(FILMS)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(printed.values())


def test_a_sweep_is_downloaded_as_one_file(run: RunCommand, site: Live, tmp_path: Path) -> None:
    here = run("export", "mine", "--format", "sweep", "--out", "here", "--storage", site.storage)
    there = run("--server", site.url, "export", "mine", "--format", "sweep", "--out", "there")
    assert (here.exit_code, there.exit_code) == (0, 0)
    assert there.stdout.split() == here.stdout.replace("here", "there").split()
    assert (
        (tmp_path / "there.tunejobs").read_bytes()[:2] == (tmp_path / "here.tunejobs").read_bytes()[:2] == b"\x1f\x8b"
    )
    run("--server", site.url, "export", "mine", "--out", "new/x.tunejobs")
    assert (tmp_path / "new" / "x.tunejobs").is_file()


# -- what is refused


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("launch x.yaml --address auto", "--address"), ("launch x.yaml --no-finish", "--no-finish"),
        ("resume mine --storage s", "--storage"), ("extend mine --num-samples 2 --allow-module m", "--allow-module"),
        ("launch x.yaml --dry-run --address auto", "--address"), ("status mine --storage s", "--storage"),
        ("best mine --num-episodes 7", "--num-episodes"), ("video mine --seed 3", "--seed"),
        ("evaluate mine", "`tune-jobs evaluate`"), ("compare mine other --html x.html", "--html"),
        ("compare ../mine other", "is no name of a sweep"), ("compare mine/../x other", "is no id of a trial"),
        ("export mine", "--format sweep"), ("export mine --format sweep --top 2", "--format sweep"),
        ("export mine failed --format sweep", "--format sweep"), ("importance a/b", "is no name of a sweep"),
        ("reproduce mine/t0001", "`tune-jobs reproduce`"), ("serve", "`tune-jobs serve`"),
        ("token list", "`tune-jobs token list`"), ("launch none.yaml", "none.yaml"),
        ("status a/b", "is no name of a sweep"), ("attach mine", "`tune-jobs attach`"),
    ],
)  # fmt: skip
def test_what_goes_with_no_service_is_refused(run: RunCommand, site: Live, arguments: str, words: str) -> None:
    result = run("--server", site.url, *arguments.split())
    assert result.exit_code == 2, result.output
    assert words in result.stderr
    assert "error: " in result.stderr


def test_all_commands_are_done_there_or_refused_or_about_nothing_there() -> None:
    about_neither = {"presets", "hyperparams", "schema"}
    refused = {"attach", "evaluate", "reproduce", "serve", "token"}
    assert {*THERE, *about_neither, *refused} == cli.commands.keys()
    told = re.search(r"`launch` \(.*? go to the\s+service; (.*?) need none.*? are refused: (.*?)\. ", GUIDE, re.DOTALL)
    named = [set(re.findall(r"`([a-z]+)\b", words)) for words in present(told).group(0, 1, 2)]
    assert named == [cli.commands.keys(), about_neither, refused]
    assert "--output" in {name for item in cli.commands["report"].params for name in item.opts}
    assert isinstance(cli, click.Group)


def test_the_guides_problem_document_is_the_services_answer(site: Live) -> None:
    (example,) = re.findall(r"```json\n(\{\"type\": \"about:blank\".*?)```", GUIDE, re.DOTALL)
    wrong = {"env": "CartPole-v1", "algorithm": "ppo", "space": {"hiden_sizes": {"grid": [[32], [64]]}}}
    answer = httpx2.post(f"{site.url}/api/v1/plans", json={"spec": wrong}, timeout=30)
    # Python 3.13 has another phrase for this status.
    assert answer.json() == json.loads(example) | {"title": HTTPStatus(answer.status_code).phrase}


def test_what_is_about_no_sweep_needs_no_service(run: RunCommand) -> None:
    for words in ("presets", "hyperparams ppo", "schema", "--version"):
        assert run("--server", "http://127.0.0.1:1", *words.split()).exit_code == 0
    # An empty one is none.
    assert "no sweeps" in run("--server", "", "list").stdout
    assert run("report", "mine", "-o", "x").exit_code == 2


@pytest.mark.parametrize(
    ("url", "code", "words"),
    [
        ("http://127.0.0.1:1", 5, "can't be reached"), ("127.0.0.1:8470", 2, "http://"),
        ("http://ann:s3cret@127.0.0.1:1", 2, "password"),
    ],
)  # fmt: skip
def test_addresses_are_checked(run: RunCommand, url: str, code: int, words: str) -> None:
    result = run("--server", url, "list", "--json")
    assert result.exit_code == code
    assert words in result.stderr
    assert words in json.loads(result.stdout)["error"]
    assert "s3cret" not in result.output


def test_a_token_comes_from_the_environment_or_a_file(
    run: RunCommand, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    storage = tmp_path / "kept"
    secret = run("token", "make", "ann", "--role", "viewer", "--storage", storage).stdout.strip()
    with serving(storage, require_token=True) as made:
        asked = ("--server", made.url, "list")
        assert run(*asked).exit_code == 5
        assert "TUNE_JOBS_TOKEN" in run(*asked).stderr
        monkeypatch.setenv("TUNE_JOBS_TOKEN", secret)
        assert run(*asked).exit_code == 0
        monkeypatch.setenv("TUNE_JOBS_TOKEN", "wrong")
        (tmp_path / "token").write_text(secret)
        assert run("--token-file", "token", *asked).exit_code == 0
