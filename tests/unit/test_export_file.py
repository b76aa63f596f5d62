"""A sweep as one file: what it holds, and what stays behind."""

import gzip
import json
import math
import re
import shutil
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from live_service import Live, live  # noqa: F401 (a fixture)
from page_sweeps import write_sweep
from sweep_folders import make_sweep_folder
from synthetic_sweep import make_points, make_sweep

import tune_jobs
from analysis.records import IterationRecord, JobRecord
from analysis.waits import WaitRecord
from policies.errors import SpecError
from tune_jobs.cli.commands import cli
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps import sweep_file as module
from tune_jobs.sweeps.plain import to_json
from tune_jobs.sweeps.shortened_paths import Shortener
from tune_jobs.sweeps.sweep_file import FORMAT, FORMAT_VERSION, MAX_BYTES, sweep_file

# ruff: noqa: F811 - fixtures are named as arguments

ROOT = Path(__file__).parents[2]
JS = ROOT / "tune_jobs" / "service" / "page" / "static" / "js"


def content_of(packed: bytes) -> dict[str, Any]:
    """What is in a file, which is JSON as the standard has it."""

    def refuse(word: str) -> None:
        raise AssertionError(f"{word} is no JSON")

    found: dict[str, Any] = json.loads(gzip.decompress(packed), parse_constant=refuse)
    return found


def write_finished(storage: Path, name: str = "mine", **given: Any) -> SweepStore:
    """Write a sweep that has ended, with a winner."""
    made = make_sweep(name=name, points=make_points(4, np.random.default_rng(1)), **given)
    return write_sweep(
        storage,
        made,
        created_at=1_000.0,
        started_at=1_001.0,
        ended_at=5_000.0,
    )


@pytest.fixture(scope="module")
def storage(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("some where") / "sweeps"
    write_finished(folder, seeds_per_point=2, failed={3})
    return folder


@pytest.fixture(scope="module")
def found(storage: Path) -> dict[str, Any]:
    return content_of(sweep_file(SweepStore(storage / "mine")))


# -- what it holds


def test_a_file_holds_what_the_page_shows(storage: Path, found: dict[str, Any]) -> None:
    assert (found["format"], found["version"]) == (FORMAT, FORMAT_VERSION)
    records = tune_jobs.trials("mine", storage=storage)
    assert [item["trial_id"] for item in found["trials"]] == [record.trial_id for record in records]
    for item, record in zip(found["trials"], records, strict=True):
        for name in ("status", "point", "hyperparams", "seed", "num_env_steps", "stop_reason", "started_at"):
            assert item[name] == to_json(getattr(record, name)), name
    store = SweepStore(storage / "mine")
    for trial_id, columns in found["curves"].items():
        rows = store.trial(trial_id).read_iterations()
        for name, values in columns.items():
            assert values == [getattr(row, name) for row in rows]
    assert found["importance"] == to_json(tune_jobs.importance("mine", storage=storage))
    assert found["best"]["checkpoint"]["trial_id"] == store.read_best().checkpoint.trial_id
    assert found["best"]["settings"]["ranking"][0]["trial_ids"]
    status = tune_jobs.status("mine", storage=storage)
    assert found["status"]["counts"] == status.counts
    assert found["status"]["num_env_steps"] == status.num_env_steps
    assert found["sweep"]["spec"]["space"]["lr"] == {"uniform": [1e-7, 1e-2]}
    assert found["as_of"] == 5_000.0


def test_scores_are_those_of_the_command_line(found: dict[str, Any]) -> None:
    scores = {item["trial_id"]: item["score"] for item in found["trials"]}
    assert scores["t0003"] is None
    assert max(score for score in scores.values() if score is not None) > 0
    failed = next(item for item in found["trials"] if item["status"] == "failed")
    assert "ZeroDivisionError" in failed["error"]


def test_the_guide_names_each_part(found: dict[str, Any]) -> None:
    guide = (ROOT / "docs" / "guides" / "exports.md").read_text().split("\n## One file\n")[1].split("\n## ")[0]
    told = set(re.findall(r"`(\w+)`", "\n".join(line.split("|")[1] for line in guide.splitlines() if "| `" in line)))
    assert told == set(found)
    assert f"`version` | {FORMAT_VERSION}" in guide


def test_the_page_reads_this_format_and_as_many_bytes() -> None:
    reader = (JS / "sweep_file.js").read_text()
    assert f'const FORMAT = "{FORMAT}";\nconst VERSION = {FORMAT_VERSION};' in reader
    most = re.search(r"const MOST_BYTES = (\d+) \* 2 \*\* (\d+);", reader)
    assert most is not None
    assert int(most[1]) * 2 ** int(most[2]) == MAX_BYTES


def test_a_sweep_without_results_is_a_file_too(tmp_path: Path) -> None:
    made = make_sweep(name="new", points=[{}], pending={0}, with_best=False)
    store = write_sweep(tmp_path, made, state="created", created_at=7.0, started_at=None, ended_at=None)
    found = content_of(sweep_file(store))
    assert found["best"] is None
    assert found["curves"] == {}
    assert found["status"]["best"] is None
    assert found["importance"]["too_few"]
    assert found["as_of"] == 7.0


def test_numbers_that_are_none_become_null(tmp_path: Path) -> None:
    store = make_sweep_folder(tmp_path / "odd")
    trial = store.trial("t0001")
    odd = {"time_s": math.nan, "started_at": math.inf, "error": "x\x00 ünï"}
    trial.write_record(trial.read_record().model_copy(update=odd))
    row = IterationRecord(
        iteration=7, num_env_steps=99_999, num_episodes=1, time_s=math.inf, training_return=math.nan,
        evaluation_return=-math.inf, learner={"loss": math.nan},
    )  # fmt: skip
    trial.append_iterations([row])
    found = content_of(sweep_file(store))
    item = found["trials"][1]
    assert item["time_s"] is None
    assert item["started_at"] is None
    assert "ünï" in item["error"]
    columns = found["curves"]["t0001"]
    assert columns["num_env_steps"][-1] == 99_999
    assert columns["training_return"][-1] is None
    assert columns["evaluation_return"][-1] is None
    assert found["as_of"] == 2.0


def test_a_sweep_that_runs_is_as_it_is_now(tmp_path: Path) -> None:
    made = make_sweep(name="live", points=make_points(1, np.random.default_rng(0)), pending={3}, with_best=False)
    store = write_sweep(tmp_path, made, state="running", ended_at=None)
    trial = store.trial("t0002")
    trial.write_record(trial.read_record().model_copy(update={"status": "running", "ended_at": None}))
    with store.lock():
        found = content_of(sweep_file(store))
        assert found["status"]["state"] == "running"
        assert found["status"]["counts"] == {"completed": 2, "running": 1, "pending": 1}
        assert abs(found["as_of"] - time.time()) < 60
    assert content_of(sweep_file(store))["status"]["state"] == "interrupted"


def test_many_trials_have_fewer_points_each() -> None:
    rows = [
        IterationRecord(iteration=n, num_env_steps=n, num_episodes=n, time_s=1.0, training_return=n / 7)
        for n in range(1, 1_501)
    ]
    of_few = module._curves({"t0000": rows, "t0001": []})
    assert list(of_few) == ["t0000"]
    assert len(of_few["t0000"]["iteration"]) == 1_000
    of_many = module._curves({f"t{n:04d}": rows[: 500 + n % 2] for n in range(1_000)})
    assert {len(columns["iteration"]) for columns in of_many.values()} == {200}
    assert of_many["t0999"]["iteration"][-1] == 501
    packed = gzip.compress(json.dumps(of_many).encode())
    assert len(packed) < 5_000_000


def test_more_than_readers_take_is_refused(storage: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_BYTES", 10_000)
    with pytest.raises(SpecError, match="no more than 10,000") as caught:
        tune_jobs.export("mine", "sweep", storage=storage)
    assert "csv" in caught.value.hint


# -- what stays behind


def test_the_same_sweep_is_the_same_file_wherever_it_lies(storage: Path, tmp_path: Path) -> None:
    one = sweep_file(SweepStore(storage / "mine"))
    assert one == sweep_file(SweepStore(storage / "mine"))
    shutil.copytree(storage / "mine", tmp_path / "elsewhere" / "mine")
    assert one == sweep_file(SweepStore(tmp_path / "elsewhere" / "mine"))


def test_no_path_node_or_variable_leaves_the_machine(tmp_path: Path) -> None:
    folder = tmp_path / "jo do's sweeps"
    secret = "/home/jodo/secret project/envs/cart.py"
    error = f"""EnvError: {folder}/mine/trials/t0001/log.txt is full
  File "{secret}", line 31, in step
  File "/opt/python/lib/gymnasium/core.py", line 1
see https://example.org/a/b?c=d or ~/notes/cart.md; 3/4 env steps/s"""
    store = write_finished(folder, failed={1}, error=error)
    trial = store.trial("t0002")
    changes = {
        "notes": (f"{folder}/mine/x y is damaged", f"as {folder}/other/x is"), "node": "node-7.example.org/abc",
        "ran_with": {"cpu": "secret cpu", "OMP_NUM_THREADS": "7"},
        "hyperparams": {"file": "/data/jodo/map.txt", "/data/jodo/key": 1},
    }  # fmt: skip
    trial.write_record(trial.read_record().model_copy(update=changes))
    address = {"address": "ray://head.example.org:10001", "allowed_modules": ("secret_module",)}
    store.write_record(store.read_record().model_copy(update=address))
    packed = sweep_file(store)
    text = gzip.decompress(packed).decode()
    for word in ("jodo", "jo do", str(tmp_path), "/opt", "/home", "secret", "example.org:", "node-7", "OMP_NUM"):
        assert word not in text, word
    failed = content_of(packed)["trials"][1]["error"]
    assert failed.splitlines() == [
        "EnvError: …/trials/t0001/log.txt is full",
        '  File "…/cart.py", line 31, in step',
        '  File "…/core.py", line 1',
        "see https://example.org/a/b?c=d or …/cart.md; 3/4 env steps/s",
    ]
    assert {item["node"] for item in content_of(packed)["trials"]} == {"node 1", "node 2"}


def test_no_address_of_a_cluster_leaves_it(tmp_path: Path) -> None:
    store = write_finished(tmp_path, failed={1}, error="EnvError: 10.1.2.7:80 of http://10.1.2.7/x; not 10.1.2.70")
    # Another trial ran on node 5.
    told = (
        # The node that each is on now; one that it was on before, and one that it never ran on.
        ("10.1.2.7/0a1b2c3d", ("Node 10.1.2.7 (0a1b2c3d) was lost.",)),
        ("127.0.0.1/0a1b2c3e", ("Node 10.1.2.8 (0a1b2c3f) was lost.", "127.0.0.1:80 is nobody's, 10.1.2.8 is.")),
        ("10.1.2.7/ffffffff", ("Node 10.1.2.9 (gpu-9.example.org, node 0a1b2c40) cannot take part in the sweep.",)),
        (
            "worker/0a1b2c41",
            ("A worker died on Node worker (0a1b2c41).", "Node 10.1.2.8 is full", "Node 5 (of a graph)"),
        ),
    )
    for trial, (node, notes) in zip(store.read_trials(), told, strict=False):
        store.trial(trial.trial_id).write_record(trial.model_copy(update={"node": node, "notes": notes}))
    job = JobRecord(id="mine-1a2b", address="http://head.example.org:8265")
    waiting = WaitRecord(since=1.0, lacking="One trial needs 4 CPUs; the cluster at ray://10.1.2.3:10001 has 2.")
    store.write_record(store.read_record().model_copy(update={"job": job, "waiting": waiting}))
    packed = sweep_file(store)
    text = gzip.decompress(packed).decode()
    for word in ("10.1.2.7:", "10.1.2.7/", "10.1.2.8", "10.1.2.9", "10.1.2.3", "example.org", "0a1b2c", "mine-1a2b"):
        assert word not in text, word
    found = content_of(packed)
    assert {"job", "waiting"} & set(found["sweep"]) == set()
    assert [(item["node"], item["notes"]) for item in found["trials"][:4]] == [
        ("node 1", ["Node 1 was lost."]),
        ("node 2", ["Node 6 was lost.", "127.0.0.1:80 is nobody's, node 6 is."]),
        ("node 3", ["Node 7 cannot take part in the sweep."]),
        ("node 4", ["A worker died on Node 4.", "Node 6 is full", "Node 5 (of a graph)"]),
    ]
    assert found["trials"][1]["error"] == "EnvError: node 1:80 of http://node 1/x; not 10.1.2.70"


@pytest.mark.parametrize(
    ("text", "shorter"),
    [
        ("/a/b.py:31: error", "…/b.py:31: error"),
        ("in '/a b/c d/e f.py'", "in '…/e f.py'"),
        ("PATH=/home/me/bin:/home/you/bin", "PATH=…/bin:…/bin"),
        ("file:///home/me/x.py", "…/x.py"),
        ("sqlite:////srv/me/x.db", "sqlite:…/x.db"),
        (r"C:\Users\me\x.py", "…/x.py"),
        ('"C:/Users/some body/x.py"', '"…/x.py"'),
        (r"\\server\me\x.py", "…/x.py"),
        ("~/x.py and ~me/a/x.py", "…/x.py and …/x.py"),
        ("[/a/b, (/c/d)]", "[…/b, (…/d)]"),
        ("/a/b/c/", "…/c"),
        ("ALE/Pong-v5, a/b/c and 7/8", "ALE/Pong-v5, a/b/c and 7/8"),
        ("1 / 2 / 3, /2 and // or /", "1 / 2 / 3, /2 and // or /"),
        ("https://example.org/home/me", "https://example.org/home/me"),
        (r"a\b\n", r"a\b\n"),
    ],
)
def test_of_a_path_the_last_part_stays(text: str, shorter: str) -> None:
    assert Shortener()(text) == shorter
    assert Shortener()({text: [(text,), 1, None, True]}) == {shorter: [[shorter], 1, None, True]}


def test_texts_that_look_like_paths_for_long_take_no_time() -> None:
    began = time.perf_counter()
    for text in ("/" * 50_000, "/a" * 50_000, '"/' * 50_000, "~" * 50_000, "\\" * 50_000, "'/a/" * 30_000):
        Shortener()(text + "\n")
    assert time.perf_counter() - began < 20


# -- how it is asked for


def test_the_suffix_says_what_is_written(storage: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    expected = sweep_file(SweepStore(storage / "mine"))
    assert tune_jobs.export("mine", output="a.tunejobs", storage=storage) == {"sweep": Path("a.tunejobs")}
    assert tune_jobs.export("mine", "sweep", storage=storage) == {"sweep": Path("mine.tunejobs")}
    assert tune_jobs.export("mine", "sweep", output="b.v1", storage=storage) == {"sweep": Path("b.v1.tunejobs")}
    for name in ("a.tunejobs", "mine.tunejobs", "b.v1.tunejobs"):
        assert Path(name).read_bytes() == expected
    assert tune_jobs.export("mine", output="c.TEX", storage=storage) == {"table": Path("c.TEX")}
    assert tune_jobs.export("mine", storage=storage)["trials"].parent == Path("mine-csv")


def test_the_command_writes_one_file(storage: Path, tmp_path: Path) -> None:
    run = CliRunner()
    out = tmp_path / "to send.tunejobs"
    told = run.invoke(cli, ["export", "mine", "--out", str(out), "--storage", str(storage), "--json"])
    assert told.exit_code == 0, told.output
    assert json.loads(told.stdout) == {"sweep": str(out)}
    assert out.read_bytes() == sweep_file(SweepStore(storage / "mine"))
    refused = run.invoke(cli, ["export", "mine", "mine", "--format", "sweep", "--storage", str(storage)])
    assert refused.exit_code == 2
    assert "2 sweeps were given; sweep is of one" in refused.output


def test_the_service_gives_the_same_file(live: Live) -> None:
    store = write_finished(live.storage)
    answer = live.get("/sweeps/mine/file")
    assert answer.status_code == 200
    assert answer.content == sweep_file(store)
    assert answer.headers["content-type"] == "application/gzip"
    assert answer.headers["content-disposition"] == 'attachment; filename="mine.tunejobs"'
    missing = live.get("/sweeps/nothing/file")
    assert missing.status_code == 404
    assert "nothing" in missing.json()["detail"]
    assert "application/gzip" in str(live.get("/openapi.json").json()["paths"]["/api/v1/sweeps/{name}/file"])
