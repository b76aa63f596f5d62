"""A trial run again from its record: what is compared, what may be why it differs, and what can't be repeated."""

import dataclasses
import json
import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from fake_sweeps import RunCommand
from sweep_folders import make_sweep_folder, train

import tune_jobs
from analysis.comparison.repetition import Changed, causes, first_difference
from analysis.records import IterationRecord
from policies.errors import CannotRunError, NotFoundError, SpecError
from tune_jobs.process import ran_with
from tune_jobs.spec.file import stored_spec
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps import reproduce as module

Change = Callable[[list[IterationRecord]], list[IterationRecord]]
HERE = {"cpu": "This One", "numpy": "2.0"}


@dataclasses.dataclass
class Again:
    """In the place of the training in Ray's processes."""

    change: Change = list
    """What becomes of the results of the repetition."""
    with_what: dict[str, str] = dataclasses.field(default_factory=lambda: dict(HERE))
    record: dict[str, Any] = dataclasses.field(default_factory=dict)
    folders: list[Path] = dataclasses.field(default_factory=list)
    specs: list[Any] = dataclasses.field(default_factory=list)
    error: Exception | None = None

    def __call__(self, folder: str, progress: str) -> None:
        store = SweepStore(Path(folder))
        self.folders.append(store.folder)
        self.specs.append(stored_spec(store.read_record()))
        if self.error is not None:
            raise self.error
        (known,) = store.read_trials()
        assert known.status == "pending"
        train(store, known.trial_id, self.specs[-1].stop.num_iterations)
        trial = store.trial(known.trial_id)
        trial.keep_iterations(self.change(trial.read_iterations()))
        trial.write_record(trial.read_record().model_copy(update={"ran_with": self.with_what, **self.record}))


@pytest.fixture
def again(monkeypatch: pytest.MonkeyPatch) -> Again:
    fake = Again()
    monkeypatch.setattr(module, "_train_again", fake)
    monkeypatch.setattr(module, "git_commit", lambda: None)
    return fake


@pytest.fixture
def store(tmp_path: Path) -> SweepStore:
    made = make_sweep_folder(tmp_path / "mine")
    update(made, "t0001", ran_with=HERE)
    return made


def update(store: SweepStore, trial_id: str, **changes: Any) -> None:
    trial = store.trial(trial_id)
    trial.write_record(trial.read_record().model_copy(update=changes))


def snapshot(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def with_iteration(number: int, **changes: Any) -> Change:
    """Results in which one iteration is other."""
    return lambda items: [item.model_copy(update=changes) if item.iteration == number else item for item in items]


def test_a_trial_that_comes_to_the_same_is_equal_and_nothing_of_it_changes(store: SweepStore, again: Again) -> None:
    before = snapshot(store.folder)
    found = tune_jobs.reproduce(store.folder / "trials" / "t0001", progress="none")
    assert found.equal
    assert (found.name, found.num_iterations, found.num_compared) == ("mine/t0001", 6, 6)
    assert (found.num_equal_weights, found.num_other_weights, found.causes) == (2, 0, ())
    assert found.verdict == "mine/t0001: all 6 iterations are equal, and the weights of 2 kept checkpoints."
    assert snapshot(store.folder) == before
    assert not again.folders[0].parent.exists()


def test_what_trains_again_is_the_trial_without_what_ended_others(tmp_path: Path, again: Again) -> None:
    spec = {"scheduler": {"type": "asha"}, "stop": {"num_env_steps": 900, "time_s": 5}, "max_retries": 2}
    store = make_sweep_folder(tmp_path / "mine", iterations=4, **spec)
    tune_jobs.reproduce("mine/t0002", storage=tmp_path)
    (made,) = again.specs
    assert (made.scheduler.type, made.search.type, made.max_retries) == ("none", "random", 0)
    assert (made.stop.num_iterations, made.stop.num_env_steps) == (4, 900)
    # A slower machine must not end it sooner.
    assert made.stop.time_s > 1e8
    assert made.space == stored_spec(store.read_record()).space


@pytest.mark.parametrize(
    "chosen",
    [
        {"prior": ["earlier"]},
        {"objective": ["return", "env_steps"], "space": {"stop.num_env_steps": {"choice": [900, 2_000]}}},
        {
            "algorithm": "dqn",
            "hyperparams": {},
            "space": {
                "replay": {"choice": ["uniform", "prioritized"]},
                "prioritized_alpha": {"grid": [0.1, 0.5], "when": {"replay": "prioritized"}},
            },
        },
    ],
)
def test_a_trial_that_a_model_chose_is_repeated_whatever_its_search_began_with_or_searched(
    tmp_path: Path, store: SweepStore, again: Again, chosen: dict[str, Any]
) -> None:
    record = store.read_record()
    search = {"search": {"type": "gp", "num_startup_trials": 1}, "num_samples": 4}
    stop = {"num_env_steps": 2_000} if "objective" in chosen else record.spec["stop"]
    store.write_record(record.model_copy(update={"spec": record.spec | {"stop": stop} | search | chosen}))
    was = stored_spec(store.read_record())
    tune_jobs.reproduce("mine/t0001", storage=tmp_path)
    assert again.specs[0].space == was.space


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"training_return": 20.5}, "training_return"),
        ({"evaluation_return": 9.0}, "evaluation_return"),
        ({"episode_returns": (21.0,)}, "episode_returns"),
        ({"episode_lengths": (7, 7)}, "episode_lengths"),
        ({"num_env_steps": 401}, "num_env_steps"),
        ({"learner": {"total_loss": 0.26}}, "learner/total_loss"),
        ({"learner": {}}, "learner/total_loss"),
    ],
)
def test_the_first_iteration_that_differs_is_named_with_what_differs(
    store: SweepStore, again: Again, changes: dict[str, Any], what: str
) -> None:
    again.change = with_iteration(4, **changes)
    found = tune_jobs.reproduce(store.folder / "trials" / "t0001")
    assert not found.equal
    assert found.first_difference == 4
    assert [item.what for item in found.differences] == [what]
    assert found.verdict == "mine/t0001 differs from iteration 4 of 6 on."
    assert "CPU, versions and environment variables are those that were recorded: " in "\n".join(found.lines())


def test_times_may_differ_and_a_missing_iteration_is_a_difference(store: SweepStore, again: Again) -> None:
    again.change = with_iteration(2, time_s=99.0)
    assert tune_jobs.reproduce(store.folder / "trials" / "t0001").equal
    again.change = lambda items: items[:5]
    assert tune_jobs.reproduce(store.folder / "trials" / "t0001").first_difference == 6


def test_what_is_other_than_it_was_is_told_also_where_the_numbers_are_equal(store: SweepStore, again: Again) -> None:
    again.with_what = {"cpu": "Another", "numpy": "2.0", "OPENBLAS_CORETYPE": "Haswell"}
    found = tune_jobs.reproduce(store.folder / "trials" / "t0001")
    assert found.causes == (
        Changed("cpu", "This One", "Another"),
        Changed("OPENBLAS_CORETYPE", "not set", "Haswell"),
    )
    assert "What is other than it was:" in found.lines()
    again.change = with_iteration(1, training_return=0.0)
    assert (
        "What is other than it was, and may be why:" in tune_jobs.reproduce(store.folder / "trials" / "t0001").lines()
    )


def test_of_an_older_record_the_versions_are_known_and_the_cpu_is_not(store: SweepStore, again: Again) -> None:
    record = store.read_record()
    store.write_record(record.model_copy(update={"versions": {"numpy": "1.9"}}))
    found = tune_jobs.reproduce(store.folder / "trials" / "t0000")
    assert found.causes == (Changed("numpy", "1.9", "2.0"),)
    again.change = with_iteration(1, training_return=0.0)
    store.write_record(record.model_copy(update={"versions": {"numpy": "2.0"}}))
    lines = "\n".join(tune_jobs.reproduce(store.folder / "trials" / "t0000").lines())
    assert "Versions are those that were recorded: CPU or environment variables may be others" in lines
    assert any("neither the CPU" in note and "cpu This One." in note for note in found.notes)


def test_other_weights_with_the_same_numbers_are_a_difference(
    store: SweepStore, again: Again, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = module._weights
    monkeypatch.setattr(
        module, "_weights", lambda where, kept: real(where, kept) if where.folder == store.folder else "other"
    )
    found = tune_jobs.reproduce(store.folder / "trials" / "t0001")
    assert (found.equal, found.num_other_weights) == (False, 2)
    assert "other weights in 2 checkpoints" in found.verdict


def test_what_came_after_it_continued_from_a_checkpoint_is_not_compared(store: SweepStore, again: Again) -> None:
    trial = store.trial("t0001")
    assert "built from seed" in trial.log_path.read_text()
    for iteration in (4, 2, 5):
        trial.write_log(f"built from checkpoint {iteration:06d}")
    # A user's env may print the same.
    with trial.log_path.open("a") as file:
        file.write("built from checkpoint 000001\n")
    again.change = with_iteration(3, training_return=0.0)
    found = tune_jobs.reproduce(store.folder / "trials" / "t0001")
    assert (found.equal, found.num_compared, found.num_iterations) == (True, 2, 6)
    assert found.verdict.startswith("mine/t0001: the first 2 of 6 iterations are equal")
    assert any("The last 4 iterations can't be repeated" in note for note in found.notes)
    again.change = with_iteration(2, training_return=0.0)
    assert tune_jobs.reproduce(store.folder / "trials" / "t0001").first_difference == 2


def test_a_trial_that_a_scheduler_ended_between_two_evaluations_is_repeated_up_to_there(
    store: SweepStore, again: Again
) -> None:
    trial = store.trial("t0001")
    trial.keep_iterations(with_iteration(6, evaluation_return=None)(trial.read_iterations()))
    assert tune_jobs.reproduce("mine/t0001", storage=store.folder.parent).first_difference == 6
    update(store, "t0001", status="stopped")
    found = tune_jobs.reproduce("mine/t0001", storage=store.folder.parent)
    assert found.equal
    assert any("A scheduler ended the trial there" in note for note in found.notes)


def test_a_trial_that_failed_is_repeated_into_the_iteration_in_which_it_did(store: SweepStore, again: Again) -> None:
    update(store, "t0001", status="failed", error="ValueError: x")
    again.record = {"status": "failed", "error": "ValueError: y"}
    found = tune_jobs.reproduce("mine/t0001", storage=store.folder.parent)
    assert again.specs[0].stop.num_iterations == 7
    assert found.equal
    assert any(note == "Both failed; the trial: ValueError: x; the repetition: ValueError: y" for note in found.notes)
    again.record = {}
    found = tune_jobs.reproduce("mine/t0001", storage=store.folder.parent)
    assert any("the repetition did not" in note for note in found.notes)


def packed_sweep(folder: Path, space: dict[str, list[Any]], **spec: Any) -> SweepStore:
    """A sweep of a grid whose trials packs trained."""
    grid = {name: {"grid": values} for name, values in space.items()}
    store = make_sweep_folder(folder, **{"space": grid, "num_samples": 1, "seeds_per_point": 1, **spec})
    for trial in store.read_trials():
        update(store, trial.trial_id, engine="packed", node="a", pid=7, ran_with=HERE)
    return store


def notes_of(store: SweepStore, trial_id: str) -> tuple[str, ...]:
    return tune_jobs.reproduce(store.folder / "trials" / trial_id).notes


def test_wider_layers_of_its_pack_are_told_as_its_own_may_have_been_padded(tmp_path: Path, again: Again) -> None:
    store = packed_sweep(tmp_path / "mine", {"hidden_sizes": [[17], [24], [20], [64], [24, 24]]})
    (told,) = notes_of(store, "t0000")
    assert "padded to the wider ones of t0001, t0002: then the last bits of its sums depend on those" in told
    (told,) = notes_of(store, "t0002")
    assert "the wider ones of t0001: then" in told
    for trial_id in ("t0001", "t0003", "t0004"):
        assert notes_of(store, trial_id) == ()
    # One that another engine trained was in no stack.
    update(store, "t0001", engine="rllib")
    assert notes_of(store, "t0002") == ()
    many = packed_sweep(tmp_path / "many", {"hidden_sizes": [[17], [18], [19], [20], [21], [22]]})
    (told,) = notes_of(many, "t0000")
    assert "the wider ones of t0001, t0002, t0003 and 2 others: then" in told


def test_of_one_size_or_in_stacks_of_their_own_trials_depend_on_no_others(tmp_path: Path, again: Again) -> None:
    same = packed_sweep(tmp_path / "same", {"hidden_sizes": [[24]], "lr": [1e-3, 1e-2]}, seeds_per_point=2)
    assert [notes_of(same, trial.trial_id) for trial in same.read_trials()] == [()] * 4
    space: dict[str, list[Any]] = {"hidden_sizes": [[21], [24]], "num_epochs": [3, 4]}
    apart = packed_sweep(tmp_path / "apart", space)
    epochs = {trial.trial_id: trial.hyperparams["num_epochs"] for trial in apart.read_trials()}
    for trial in apart.read_trials():
        told = re.findall("t000[0-9]", "".join(notes_of(apart, trial.trial_id)))
        assert len(told) == (trial.hyperparams["hidden_sizes"] == [21])
        assert all(epochs[name] == epochs[trial.trial_id] for name in told)


def test_sizes_by_which_its_place_in_a_pack_rounds_are_told(tmp_path: Path, again: Again) -> None:
    space: dict[str, list[Any]] = {"hidden_sizes": [[64]], "minibatch_size": [64, 63], "lr": [1e-3, 1e-2]}
    store = packed_sweep(tmp_path / "mine", space)
    for trial in store.read_trials():
        told = " ".join(notes_of(store, trial.trial_id))
        assert ("by its place among the trials of its pack" in told) is (trial.hyperparams["minibatch_size"] == 63)
    # Nobody was beside it.
    alone = packed_sweep(tmp_path / "alone", {"minibatch_size": [64, 63]})
    assert [notes_of(alone, trial.trial_id) for trial in alone.read_trials()] == [(), ()]
    # Of 20 actions' outputs torch makes the values, of as many rows as there are envs.
    values = packed_sweep(tmp_path / "values", {"lr": [1e-3, 1e-2], "num_envs": [4], "hidden_sizes": [[20]]})
    assert notes_of(values, "t0000") == ()
    values = packed_sweep(tmp_path / "others", {"lr": [1e-3, 1e-2], "num_envs": [2], "hidden_sizes": [[20]]})
    assert "by its place" in " ".join(notes_of(values, "t0000"))


def test_on_a_gpu_the_number_of_trials_may_matter(tmp_path: Path, again: Again) -> None:
    store = packed_sweep(tmp_path / "mine", {"hidden_sizes": [[64]], "lr": [1e-3, 1e-2]})
    record = store.read_record()
    spec = {**record.spec, "resources": {**record.spec["resources"], "num_gpus": 1}}
    store.write_record(record.model_copy(update={"spec": spec}))
    (told,) = notes_of(store, "t0000")
    assert "on a GPU the last bits of its sums may depend on how many" in told


def test_a_kept_repetition_is_a_sweep_of_its_own(store: SweepStore, again: Again, tmp_path: Path) -> None:
    found = tune_jobs.reproduce("mine/t0001", storage=tmp_path, output=tmp_path / "new" / "again")
    assert found.folder == tmp_path / "new" / "again"
    assert [trial.trial_id for trial in tune_jobs.trials(found.folder)] == ["t0001"]
    assert "The repetition is in " in found.lines()[-1]
    with pytest.raises(CannotRunError, match="exists already"):
        tune_jobs.reproduce("mine/t0001", storage=tmp_path, output=found.folder)


def test_nothing_is_left_where_it_cannot_run(store: SweepStore, again: Again) -> None:
    again.error = CannotRunError("no Ray")
    with pytest.raises(CannotRunError, match="no Ray"):
        tune_jobs.reproduce("mine/t0001", storage=store.folder.parent)
    assert not again.folders[0].parent.exists()


def test_what_cannot_be_repeated_is_refused_before_anything_runs(tmp_path: Path, again: Again) -> None:
    make_sweep_folder(tmp_path / "population", scheduler="pbt", seeds_per_point=1)
    store = make_sweep_folder(tmp_path / "mine")
    store.trial("t0001").keep_iterations([])
    update(store, "t0001", status="failed", error="ValueError: never began")
    refused: Sequence[tuple[str, type[Exception], str]] = [
        ("population/t0000", SpecError, "is of a population"),
        ("mine", SpecError, "is a sweep; one of its trials"),
        ("mine/t0009", NotFoundError, "no trial 't0009'"),
        ("none/t0001", NotFoundError, "No sweep"),
        ("mine/t0001", NotFoundError, "no iteration that could be repeated: it failed before .ValueError: never began"),
    ]
    for source, error, message in refused:
        with pytest.raises(error, match=message):
            tune_jobs.reproduce(source, storage=tmp_path)
    assert again.folders == []


def test_the_command_says_by_its_exit_code_whether_they_are_equal(
    store: SweepStore, again: Again, run: RunCommand
) -> None:
    equal = run("reproduce", store.folder / "trials" / "t0001")
    assert equal.exit_code == 0
    assert "all 6 iterations are equal" in equal.output
    again.change = with_iteration(4, training_return=math.nan)
    other = run("reproduce", "mine/t0001", "--storage", store.folder.parent)
    assert other.exit_code == 3
    assert "differs from iteration 4 of 6 on" in other.output
    assert "training_return: 20.0 was recorded, now None" in other.output
    document = json.loads(run("reproduce", store.folder / "trials" / "t0001", "--json").stdout)
    assert (document["equal"], document["first_difference"]) == (False, 4)


def test_nan_is_equal_to_itself() -> None:
    item = IterationRecord(
        iteration=1, num_env_steps=1, num_episodes=1, time_s=1.0, episode_returns=(math.nan, math.inf),
        learner={"loss": math.nan, "kl": None},
    )  # fmt: skip
    assert first_difference([item], [item.model_copy()], may_lack_evaluation=False) is None
    other = item.model_copy(update={"episode_returns": (math.nan, 1.0)})
    assert first_difference([item], [other], may_lack_evaluation=False) == (
        1,
        (Changed("episode_returns", "inf (episode 2)", "1.0"),),
    )


def test_causes_are_what_is_other() -> None:
    assert causes({"cpu": "a", "numpy": "1"}, {"cpu": "a", "numpy": "1"}) == ()
    assert causes({"cpu": "a", "OMP_NUM_THREADS": "1"}, {"cpu": "a"}) == (Changed("OMP_NUM_THREADS", "1", "not set"),)


# -- what is recorded


def test_the_cpu_and_its_widest_instructions_are_read(tmp_path: Path) -> None:
    info = tmp_path / "cpuinfo"
    info.write_text("processor : 0\nmodel name : A CPU @ 2 GHz\nflags : sse4_2 avx avx2 fma\n\nmodel name : other\n")
    assert ran_with._processor(info) == {"cpu": "A CPU @ 2 GHz", "instructions": "avx2"}
    assert set(ran_with._processor(tmp_path / "none")) == {"cpu"}


def test_a_trial_records_what_it_ran_with(store: SweepStore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENBLAS_CORETYPE", "Haswell")
    ran_with.ran_with.cache_clear()
    found = ran_with.ran_with()
    ran_with.ran_with.cache_clear()
    assert found["OPENBLAS_CORETYPE"] == "Haswell"
    assert {"cpu", "python", "numpy", "torch", "tune-jobs"} <= set(found)
