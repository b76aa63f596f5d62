"""Engines: which trials are packed, with which others, and why others are not."""

import json
from pathlib import Path
from typing import Any

import pytest
from pack_plans import DQN, LR, TPE, fake_reasons, plan
from spec_errors import MINIMAL, errors

from analysis.records import ReplicationRecord, TrialRecord
from policies.errors import EnvError, SpecError
from policies.guard import guarded
from policies.hyperparams import Algorithm, make_hyperparams
from tests.narrowing import present
from tune_jobs.plan.engine_choice import MAX_PRODUCTS, pack_key, why_not
from tune_jobs.plan.machine import Machine
from tune_jobs.plan.sweep_plan import SweepPlan, make_plan
from tune_jobs.spec.engines import engine_named
from tune_jobs.spec.file import load_spec
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.store.transitions import pending_record
from tune_jobs.sweeps.adding import check_same_trials
from tune_jobs.sweeps.drive import write_new

PACKED = engine_named("packed")
IMAGES: dict[str, Any] = {"env": {"id": "CartPole-v1", "pixels": True}}
SMALL, LARGE = [[4, 8, 4]], [[64, 3, 1]]
"""Filters for pictures of 40 x 60 pixels."""


@pytest.fixture
def unseedable_env(monkeypatch: pytest.MonkeyPatch) -> None:
    def check_seedable(env_id: str, env_args: dict[str, Any], *, timeout_s: float) -> None:
        raise EnvError(f"{env_id} gives other observations with the same seed.", "Set engine: rllib.")

    monkeypatch.setattr(guarded, "check_seedable", check_seedable)


# -- which engine


MEETING: list[dict[str, Any]] = [{"scheduler": "pbt"}, {"scheduler": "pb2"}, {"scheduler": "hyperband"}]
"""Sweeps whose trials wait for each other."""


@pytest.mark.parametrize("fields", MEETING)
def test_trials_that_are_added_to_a_population_have_the_engine_of_those_they_are_compared_with(
    fields: dict[str, Any],
) -> None:
    record = TrialRecord(trial_id="t0000", index=0, point_index=0, seed=1, point={"lr": 1e-3}, has_point=True)
    for engine in ("rllib", "packed"):
        made = plan(records=[record.model_copy(update={"engine": engine})], **fields)
        assert {trial.engine for trial in made.trials} == {engine}
    # One by one they are compared by what they reach, on whichever engine.
    other = plan(records=[record.model_copy(update={"engine": "rllib"})], scheduler="asha")
    assert other.engines == {"rllib": 1, "packed": 9}


def test_what_can_be_packed_is_packed() -> None:
    for fields in ({}, DQN, {"env": "Pendulum-v1"}, {"scheduler": "asha"}, {"scheduler": "median"}, TPE, *MEETING):
        made = plan(**fields)
        assert {trial.engine for trial in made.trials} == {"packed"}
        assert made.notes == ()


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"resources": {"num_env_runners": 1}}, "resources.num_env_runners is 1, and packs have no env runners"),
        ({"rl_module": "my_nets:Net"}, "rl_module is my_nets:Net, and packs have no networks but their own"),
    ],
)
def test_what_cannot_be_packed_is_left_to_rllib_with_the_reason(
    monkeypatch: pytest.MonkeyPatch, fields: dict[str, Any], reason: str
) -> None:
    monkeypatch.setattr("tune_jobs.plan.sweep_plan.check_rl_module", lambda spec: None)
    made = plan(**fields)
    assert (made.engines, made.packs) == ({"rllib": 10}, None)
    assert made.notes == (f"No trial is packed, RLlib trains them all: {reason}.",)
    # Asked for, it is refused; the other way round nobody is told what he asked for.
    message = errors(**{**fields, "num_samples": 10, "space": LR, "engine": "packed"})
    assert "sweep: engine: packed cannot" in message
    assert reason in message
    assert plan(**{**fields, "engine": "rllib"}).notes == ()


def test_an_engine_that_is_none_is_refused_with_the_nearest() -> None:
    assert "engine: 'pack' is not allowed" in errors(engine="pack")


def test_a_baseline_has_an_engine_of_its_own() -> None:
    made = plan(algorithm="random", space={}, num_samples=1)
    assert (made.engines, made.packs, made.notes) == ({"baseline": 1}, None, ())
    assert "algorithm is random, which does not learn" in errors(algorithm="random", engine="packed")


def test_small_images_are_packed_and_large_ones_where_that_is_asked_for() -> None:
    assert plan(**IMAGES, hyperparams={"conv_filters": SMALL}).engines == {"packed": 10}
    # 38 x 58 places of 3 x 3 pixels for 64 filters, and what these are for each of 64 units.
    products = 38 * 58 * 9 * 64 + 38 * 58 * 64 * 64 + 64 * 64
    made = plan(**IMAGES, hyperparams={"conv_filters": LARGE})
    assert made.engines == {"rllib": 10}
    why = f"a network makes {products:,} multiplications for an image of 40 x 60 x 1"
    faster = "and without a GPU packs are the faster engine up to 300,000"
    assert made.notes == (f"No trial is packed, RLlib trains them all: {why}, {faster}.",)
    assert plan(**IMAGES, hyperparams={"conv_filters": LARGE}, engine="packed").engines == {"packed": 10}
    assert plan(**IMAGES, hyperparams={"conv_filters": LARGE}, engine="rllib").notes == ()


def test_the_reason_names_where_packs_are_faster() -> None:
    assert f"{MAX_PRODUCTS:,}" in PACKED.lacks["large_images"]


def test_engines_are_chosen_by_each_trials_own_filters() -> None:
    made = plan(**IMAGES, space={"conv_filters": {"grid": [SMALL, LARGE]}}, num_samples=1, seeds_per_point=2)
    assert [trial.engine for trial in made.trials] == ["packed"] * 2 + ["rllib"] * 2
    assert made.notes[0].startswith("t0002, t0003 are not packed, RLlib trains them: a network makes ")
    # Of a point that is not known, any of the space.
    search: dict[str, Any] = {"search": {"type": "tpe", "num_startup_trials": 2}, "num_samples": 4}
    small = plan(**IMAGES, space={"conv_filters": {"choice": [SMALL, [[4, 8, 8]]]}}, **search)
    assert small.engines == {"packed": 4}
    mixed = plan(**IMAGES, space={"conv_filters": {"choice": [SMALL, LARGE]}}, **search)
    assert [trial.engine for trial in mixed.trials][2:] == ["rllib"] * 2


def test_large_images_are_packed_where_the_trials_have_a_gpu() -> None:
    large: dict[str, Any] = {**IMAGES, "hyperparams": {"conv_filters": LARGE}, "resources": {"num_gpus": 0.5}}
    made = make_plan(load_spec({**MINIMAL, **large}), Machine(8, 1))
    assert (made.engines, made.notes) == ({"packed": 1}, ())
    made = make_plan(load_spec({**MINIMAL, **large, "engine": "rllib"}), Machine(8, 1))
    assert made.engines == {"rllib": 1}


def test_games_may_be_packed() -> None:
    game: dict[str, Any] = {"env": {"id": "ALE/Pong-v5", "atari": True}, "hyperparams": {"conv_filters": [[32, 8, 4]]}}
    assert why_not(PACKED, load_spec({**MINIMAL, **game})) is None
    assert why_not(PACKED, load_spec({**MINIMAL, **game, "engine": "packed"})) is None


def test_engines_are_chosen_trial_by_trial(monkeypatch: pytest.MonkeyPatch) -> None:
    fake_reasons(monkeypatch, [0.2])
    space: dict[str, Any] = {"space": {"lr": {"grid": [0.1, 0.2, 0.3]}}, "num_samples": 1}
    made = plan(**space, seeds_per_point=2)
    assert [trial.engine for trial in made.trials] == ["packed"] * 2 + ["rllib"] * 2 + ["packed"] * 2
    assert made.notes == ("t0002, t0003 are not packed, RLlib trains them: its lr is odd.",)
    assert present(made.packs).trial_ids == ("t0000", "t0001", "t0004", "t0005")
    assert made.to_json()["engines"] == {"packed": 4, "rllib": 2}
    many = plan(**space, seeds_per_point=20)
    assert many.notes == ("20 trials are not packed, RLlib trains them: its lr is odd.",)
    assert plan(**space).notes == ("t0001 is not packed, RLlib trains it: its lr is odd.",)
    with pytest.raises(SpecError) as caught:
        plan(**space, engine="packed", seeds_per_point=2)
    assert caught.value.message == "engine is packed, but point 1 (lr 0.2; first trial t0002) cannot be: its lr is odd."
    # More seeds of point 0 came first, when the sweep had no other.
    spec = load_spec({**MINIMAL, **space, "engine": "packed", "seeds_per_point": 2})
    before = (ReplicationRecord(num_points=1, points=(0, 0, 0)),)
    with pytest.raises(SpecError, match=r"point 1 \(lr 0.2; first trial t0005\) cannot be"):
        make_plan(spec, Machine(2), replications=before)
    assert "engine to rllib" in caught.value.hint
    assert "auto" in caught.value.hint


def test_environments_without_seeds_are_left_to_rllib(unseedable_env: None) -> None:
    reason = "CartPole-v1 gives other observations with the same seed"
    made = plan()
    assert made.notes == (f"No trial is packed, RLlib trains them all: {reason}.",)
    with pytest.raises(SpecError, match=rf"engine is packed, but point 0 \(lr .*{reason}"):
        plan(engine="packed")
    # Not even looked at where it does not matter.
    assert plan(engine="rllib").notes == ()


def test_a_dry_run_shows_the_engine_of_each_trial_if_they_differ(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from tune_jobs.cli.plan_view import show_plan

    fake_reasons(monkeypatch, [0.2])
    fields: dict[str, Any] = {"space": {"lr": {"grid": [0.1, 0.2, 0.3]}}, "num_samples": 1}
    show_plan(load_spec({**MINIMAL, **fields}), plan(**fields), as_json=False)
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert next(line for line in lines if line[:1] == ["engine"])[1:5] == ["packed", "2,", "rllib", "1;"]
    assert [line[-1] for line in lines if line and line[0].startswith("t000")][-3:] == ["packed", "rllib", "packed"]


# -- going on


def written(tmp_path: Path, made: SweepPlan, spec: SweepSpec) -> SweepStore:
    store = SweepStore(tmp_path / "mine")
    store.create()
    write_new(store, spec, made, None)
    return store


def test_trials_go_on_with_the_engines_they_have(tmp_path: Path) -> None:
    fields = {**MINIMAL, "num_samples": 4, "space": LR}
    spec = load_spec(fields)
    made = make_plan(spec, Machine(2))
    store = written(tmp_path, made, spec)
    # A trial of an older version, whose record names no engine.
    path = store.trial("t0001").record_path
    record = json.loads(path.read_text())
    assert record.pop("engine") == "packed"
    path.write_text(json.dumps(record))
    ended = store.trial("t0002").read_record()
    store.trial("t0002").write_record(ended.model_copy(update={"status": "completed"}))
    failed = store.trial("t0003").read_record()
    store.trial("t0003").write_record(failed.model_copy(update={"status": "failed"}))

    again = make_plan(load_spec({**fields, "num_samples": 6}), Machine(2), store.read_trials())
    check_same_trials(store, again)
    assert [trial.engine for trial in again.trials] == ["packed", "rllib", *["packed"] * 4]
    # Packs are for what is left to be trained.
    assert present(again.packs).trial_ids == ("t0000", "t0004", "t0005")
    retried = make_plan(spec, Machine(2), store.read_trials(), retry_failed=True)
    assert present(retried.packs).trial_ids == ("t0000", "t0003")
    assert pending_record(again.trials[1]).engine == "rllib"
    # What the file wishes is for new trials.
    forced = make_plan(load_spec({**fields, "engine": "packed"}), Machine(2), store.read_trials())
    assert forced.engines == {"packed": 3, "rllib": 1}
    none_new = make_plan(load_spec({**fields, "engine": "rllib"}), Machine(2), store.read_trials())
    assert none_new.engines == {"packed": 3, "rllib": 1}


def test_packs_are_gone_when_all_packed_trials_have_ended() -> None:
    made = plan()
    ended = [pending_record(trial).model_copy(update={"status": "completed"}) for trial in made.trials]
    again = plan(records=ended)
    assert (again.packs, again.engines) == (None, {"packed": 10})


# -- stacks


def test_what_can_be_stacked_is_handed_out_together() -> None:
    space = {"hidden_sizes": {"grid": [[8], [8, 8]]}, "activation": {"grid": ["tanh", "relu"]}}
    made = plan(space=space, num_samples=1, seeds_per_point=2)
    layers = {trial.trial_id: len(trial.point["hidden_sizes"]) for trial in made.trials}
    assert [layers[name] for name in present(made.packs).trial_ids] == [1] * 4 + [2] * 4
    assert present(made.packs).trial_ids[:4] == ("t0000", "t0001", "t0002", "t0003")
    mixed = plan(space={"num_envs": {"grid": [8, 16]}, "activation": {"grid": ["tanh", "relu"]}}, num_samples=2)
    ids = [trial.trial_id for trial in mixed.trials if trial.point["num_envs"] == 8]
    assert present(mixed.packs).trial_ids[:4] == tuple(ids)
    # Points that are not known come last.
    made = plan(**(TPE | {"search": {"type": "tpe", "num_startup_trials": 3}}))
    assert present(made.packs).trial_ids == tuple(trial.trial_id for trial in made.trials)


ALIKE = {
    "ppo": {"lr": 0.1, "activation": "relu", "hidden_sizes": [9, 7], "gamma": 0.5, "clip_param": 0.3, "grad_clip": 1.0},
    "dqn": {
        "lr": 0.1, "activation": "tanh", "hidden_sizes": [9, 7], "replay_capacity": 99, "epsilon_decay": 5.0,
        "adam_beta1": 0.5, "target_update_freq": 7,
        "learning_starts": 5,
    },
}  # fmt: skip
APART = {
    "ppo": {
        "hidden_sizes": [8], "num_envs": 3, "normalize_observations": True, "vf_share_layers": True,
        "use_kl_loss": True, "train_batch_size": 512, "minibatch_size": 128, "num_epochs": 2,
    },
    "dqn": {
        "hidden_sizes": [8], "num_envs": 3, "normalize_observations": True, "train_batch_size": 16,
        "env_steps_per_iteration": 77, "train_freq": 3, "updates_per_env_step": 1.0, "double_q": False,
        "dueling": False, "n_step": 3, "td_loss": "mse", "optimizer": "rmsprop", "replay": "prioritized",
        "target_update_unit": "episode", "tau": 0.5, "epsilon_unit": "episode",
    },
}  # fmt: skip


@pytest.mark.parametrize("algorithm", ["ppo", "dqn"])
def test_members_of_a_stack_share_what_shapes_their_work(algorithm: Algorithm) -> None:
    key = pack_key(make_hyperparams(algorithm, {}))
    for name, value in ALIKE[algorithm].items():
        assert pack_key(make_hyperparams(algorithm, {name: value})) == key, name
    for name, value in APART[algorithm].items():
        assert pack_key(make_hyperparams(algorithm, {name: value})) != key, name


def test_two_kinds_of_target_updates_are_not_stacked() -> None:
    values: list[dict[str, Any]] = [
        {"tau": 0.5}, {"tau": 0.5, "target_update_freq": 4}, {"double_q": False},
        {"double_q": False, "target_network": False},
    ]  # fmt: skip
    keys = {pack_key(make_hyperparams("dqn", each)) for each in values}
    assert len(keys) == 4
    assert pack_key(make_hyperparams("dqn", {"tau": 0.5})) == pack_key(make_hyperparams("dqn", {"tau": 0.1}))
    with pytest.raises(TypeError):
        pack_key(make_hyperparams("random", {}))


def test_trials_are_listed_with_their_engines_if_they_differ(capsys: pytest.CaptureFixture[str]) -> None:
    from tune_jobs.cli.trials_table import show_trials

    records = [pending_record(trial) for trial in plan(num_samples=2).trials]
    show_trials(records, as_json=False)
    assert "engine" not in capsys.readouterr().out
    show_trials([records[0], records[1].model_copy(update={"engine": "rllib"})], as_json=False)
    lines = [line.split() for line in capsys.readouterr().out.splitlines() if line.strip()]
    assert lines[0][-1] == "engine"
    assert [line[-1] for line in lines if line[0].startswith("t000")] == ["packed", "rllib"]
