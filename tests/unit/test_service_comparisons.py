"""Sweeps side by side over HTTP: what `compare` says, how each rose and learnt, and what can't be compared."""

import json
from pathlib import Path
from typing import Any

import httpx2
import pytest
from fake_sweeps import run  # noqa: F401 (a fixture)
from live_service import Live, live, serving, serving_a_viewer  # noqa: F401 (a fixture)
from store_parts import make_best, make_iteration
from sweep_folders import chosen, make_sweep_folder

from analysis.best_records import EvaluationRecord
from analysis.best_so_far import best_so_far
from analysis.records import IterationRecord, TrialRecord
from tune_jobs.service import derived
from tune_jobs.spec.differences import differences
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps import side_by_side as module

# ruff: noqa: F811 - fixtures are named as arguments


def compared(live: Live, *names: str, status: int = 200, **options: Any) -> Any:
    answer: httpx2.Response = live.get("/comparisons", params={"sweeps": ",".join(names)}, **options)
    assert answer.status_code == status, answer.text
    return answer.json()


@pytest.fixture
def stores(live: Live) -> dict[str, SweepStore]:
    """Two sweeps of two settings with two seeds each; the second is trained for longer, by another lr."""
    return {
        "one": make_sweep_folder(live.storage / "one"),
        "two": make_sweep_folder(live.storage / "two", iterations=8, space={"lr": {"loguniform": [1e-5, 1e-3]}}),
    }


def test_it_says_what_the_command_says(live: Live, stores: dict[str, SweepStore], run: Any) -> None:
    result = run("compare", "one", "two", "--storage", live.storage, "--json")
    found = compared(live, "one", "two")
    assert found["comparison"] == json.loads(result.stdout)
    told = run("compare", "one", "two", "--storage", live.storage).stdout
    assert [verdict["verdict"] for verdict in found["verdicts"]] != []
    assert all(verdict["verdict"] in told for verdict in found["verdicts"])
    facts = {fact["title"]: fact["cells"] for fact in found["facts"]}
    assert facts["state"] == ["completed", "completed"]
    assert facts["sweep"] == ["one", "two"]
    assert all(len(cells) == 2 for cells in facts.values())


def test_the_curves_are_those_of_the_trials(live: Live, stores: dict[str, SweepStore]) -> None:
    found = compared(live, "one", "two")
    assert found["returns"] == "evaluation"
    one, two = found["best_so_far"]
    trials = stores["two"].read_trials()
    assert two["spent"] == sum(trial.num_env_steps for trial in trials)
    # Trial 3 scores 30 and the number of the iteration.
    assert [item["improvements"][-1]["value"] for item in (one, two)] == [36.0, 38.0]
    values = [item["value"] for item in two["improvements"]]
    assert values == sorted(set(values))
    for letter, learning in zip("AB", found["learning"], strict=True):
        assert learning["letter"] == letter
        assert learning["num_seeds"] == 2
        low, mean, high = learning["lower"], learning["mean"], learning["upper"]
        assert all(a <= b <= c for a, b, c in zip(low, mean, high, strict=True))
    # The leading setting's seeds scored 20 + n and 30 + n in iteration n.
    assert found["learning"][1]["mean"][-1] == pytest.approx(33.0)


def test_a_curve_says_how_many_seeds_it_lacks(live: Live, stores: dict[str, SweepStore]) -> None:
    # Before its first evaluation.
    trial = stores["two"].trial("t0002")
    trial.write_record(trial.read_record().model_copy(update={"status": "failed", "error": "ValueError: x"}))
    (trial.folder / "results.jsonl").unlink()
    one, two = compared(live, "one", "two")["learning"]
    assert (one["num_seeds"], one["num_without"]) == (2, 0)
    assert (two["num_seeds"], two["num_without"]) == (1, 1)


def test_only_what_differs_of_the_sweep_files_is_told(live: Live, stores: dict[str, SweepStore]) -> None:
    found = {item["path"]: item["texts"] for item in compared(live, "one", "two")["differences"]}
    assert found["space.lr"] == ["{uniform: [0.0001, 0.01]}", "{loguniform: [1.0e-05, 0.001]}"]
    assert set(found) == {"space.lr"}


def test_fields_that_one_lacks_are_differences() -> None:
    specs = [
        {"name": "a", "env": {"id": "X-v1", "args": {}}, "scheduler": {"type": "none"}, "space": {"lr": {"grid": [1]}}},
        {"name": "b", "env": {"id": "X-v1", "args": {"gap": 0.5}}, "scheduler": {"type": "asha", "eta": 3}},
    ]  # fmt: skip
    found = {item.path: item.texts for item in differences(specs)}
    assert found == {
        "env.args": ("{}", "not set"),
        "env.args.gap": ("not set", "0.5"),
        "scheduler.type": ("none", "asha"),
        "scheduler.eta": ("not set", "3"),
        "space.lr": ("{grid: [1]}", "not set"),
    }
    assert differences([specs[0], specs[0]]) == []
    (long,) = differences([{"env": "x" * 5_000}, {"env": "y"}])
    assert len(long.texts[0]) == 500


def test_the_policy_to_deploy_is_told_with_its_interval(live: Live, stores: dict[str, SweepStore]) -> None:
    confirmed = EvaluationRecord(
        policy="p",
        env_id="CartPole-v1",
        seeds=(1, 2, 3),
        returns=(190.0, 200.0, 195.0),
        lengths=(1, 1, 1),
        threshold=190.0,
    )
    stores["one"].write_best(make_best(**chosen(stores["one"]), confirmation=confirmed))
    facts = {fact["title"]: fact["cells"] for fact in compared(live, "one", "two")["facts"]}
    one, two = facts["policy to deploy"]
    assert one == "195.0 (182.6 to 207.4 with 95 %) over 3 fresh episodes, solved"
    assert two == "-"


def test_a_running_sweep_is_compared_by_what_it_has(live: Live, stores: dict[str, SweepStore]) -> None:
    store = stores["two"]
    for trial_id in ("t0001", "t0002", "t0003"):
        trial = store.trial(trial_id)
        trial.write_record(trial.read_record().model_copy(update={"status": "running", "ended_at": None}))
    store.write_record(store.read_record().model_copy(update={"state": "running"}))
    with store.lock():
        found = compared(live, "one", "two")
    assert any("Sweep two is running: 1 of 4 trials have ended" in note for note in found["comparison"]["notes"])
    assert found["best_so_far"][1]["improvements"][-1]["value"] == 38.0


def test_a_sweep_of_which_nothing_has_ended_says_why_there_is_no_score(
    live: Live, stores: dict[str, SweepStore]
) -> None:
    store = stores["two"]
    for record in store.read_trials():
        store.trial(record.trial_id).write_record(record.model_copy(update={"status": "running", "ended_at": None}))
    store.write_record(store.read_record().model_copy(update={"state": "running"}))
    with store.lock():
        found = compared(live, "one", "two")
    assert found["comparison"]["entries"][1]["why_none"] == "none of its 4 trials has ended yet"
    assert [item["letter"] for item in found["learning"]] == ["A"]
    assert "can't be said" in found["verdicts"][0]["verdict"]


# -- what is refused


@pytest.mark.parametrize(
    ("names", "status", "words"),
    [
        (["one", "nothing"], 404, "There is no sweep 'nothing'."),
        (["one", "../one"], 404, "'../one' cannot be a sweep's name."),
        ([], 422, "0 sweeps were given to be compared."),
        (["one"], 422, "1 sweep was given to be compared."),
        (["one", "one"], 422, "one was named twice"),
        (["one", "pendulum"], 422, "one is on CartPole-v1, pendulum on Pendulum-v1"),
        (["one", "longer"], 422, "one and longer give CartPole-v1 different arguments"),
        (["one", "two", "s3", "s4", "s5", "s6", "s7"], 422, "7 sweeps were given to be compared."),
    ],
)
def test_what_cannot_be_compared_is_said(
    live: Live, stores: dict[str, SweepStore], names: list[str], status: int, words: str
) -> None:
    for name in {*names} - {"one", "two", "nothing", "../one"}:
        store = make_sweep_folder(live.storage / name, iterations=1)
        record = store.read_record()
        env = {
            "pendulum": {"id": "Pendulum-v1"},
            "longer": {"id": "CartPole-v1", "args": {"sutton_barto_reward": True}},
        }
        store.write_record(record.model_copy(update={"spec": record.spec | {"env": env.get(name, record.spec["env"])}}))
    found = compared(live, *names, status=status)
    assert words in found["detail"]
    assert found["hint"]


def test_the_query_is_needed(live: Live) -> None:
    assert live.get("/comparisons").status_code == 422


def test_a_viewer_may_compare_and_nobody_without_a_token(tmp_path: Path) -> None:
    storage = tmp_path / "sweeps"
    for name in ("one", "two"):
        make_sweep_folder(storage / name, iterations=2)
    with serving_a_viewer(storage, "vera") as (closed, secret):
        compared(closed, "one", "two", status=401)
        compared(closed, "one", "two", headers={"Authorization": f"Bearer {secret}"})


# -- what it takes


def test_it_is_worked_out_once_until_one_of_them_changes(
    live: Live, stores: dict[str, SweepStore], monkeypatch: pytest.MonkeyPatch
) -> None:
    made, original = list[list[str]](), module.side_by_side

    def count(given: Any) -> Any:
        made.append([store.name for store in given])
        return original(given)

    monkeypatch.setattr(module, "side_by_side", count)
    for _ in range(3):
        first = compared(live, "one", "two")
    assert made == [["one", "two"]]
    # The letters are others.
    assert compared(live, "two", "one") != first
    trial = stores["two"].trial("t0001")
    with stores["two"].lock():
        trial.write_record(trial.read_record().model_copy(update={"status": "failed"}))
        # While it runs, not at each change: that would take all the time.
        monkeypatch.setattr(derived, "_SHARE", 1e-9)
        assert compared(live, "one", "two") == first
        assert len(made) == 2
    assert compared(live, "one", "two") != first
    assert len(made) == 3


def test_a_sweep_of_the_same_name_is_another(live: Live, stores: dict[str, SweepStore]) -> None:
    first = compared(live, "one", "two")
    stores["two"].delete()
    make_sweep_folder(live.storage / "two", iterations=3)
    assert compared(live, "one", "two") != first


# -- best so far


def trial(index: int, started_at: float | None) -> TrialRecord:
    return TrialRecord(
        trial_id=f"t{index:04d}", index=index, point_index=index, seed=index, point={}, started_at=started_at
    )


def rows(*values: float | None, training: float = 1.0) -> list[IterationRecord]:
    return [
        make_iteration(number, evaluation_return=value, training_return=training)
        for number, value in enumerate(values, start=1)
    ]


def test_the_best_so_far_rises_in_the_order_of_time() -> None:
    results = {"t0000": rows(None, 5.0, 9.0), "t0001": rows(7.0, 6.0)}
    found = best_so_far([trial(0, 10.0), trial(1, 10.5)], results, evaluated=True)
    # Moments: 11 (t0000), 11.5 (t0001), 12, 12.5, 13.
    assert [(item.spent, item.value, item.trial_id) for item in found.improvements] == [
        (200, 7.0, "t0001"),
        (500, 9.0, "t0000"),
    ]
    assert (found.spent, found.is_timed) == (500, True)
    untimed = best_so_far([trial(1, None), trial(0, 10.0)], results, evaluated=True)
    assert not untimed.is_timed
    assert [item.spent for item in untimed.improvements] == [200, 300]
    none = best_so_far([trial(0, 10.0)], {}, evaluated=False)
    assert (none.improvements, none.spent) == ((), 0)


def test_a_sweep_whose_process_was_killed_is_interrupted_as_in_the_list(tmp_path: Path) -> None:
    made = [make_sweep_folder(tmp_path / name) for name in ("one", "two")]
    made[1].write_record(made[1].read_record().model_copy(update={"state": "running"}))
    facts = {fact.title: fact.cells for fact in module.side_by_side(made).facts}
    assert facts["state"] == ("completed", "interrupted")
