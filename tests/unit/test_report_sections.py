"""What a sweep cost, what to do next, and all trials: as the report shows them."""

import json
import re
from typing import Any

import numpy as np
import pytest
import yaml
from report_sources import source_of
from synthetic_sweep import Synthetic, make_points, make_sweep

from analysis.page import all_trials, cost, head, next_steps, repeat
from analysis.page.narrowed import narrowed_space
from analysis.page.next_steps import Step
from analysis.records import TrialRecord
from policies.foreign_code import rllib_program, stable_baselines3_program
from policies.foreign_names import FOREIGN_NAMES
from policies.hyperparams import Algorithm, DQNHyperparams, PPOHyperparams
from tests.narrowing import present
from tune_jobs.spec.file import load_spec


def with_spec(synthetic: Synthetic, **fields: Any) -> Synthetic:
    synthetic.sweep = synthetic.sweep.model_copy(update={"spec": synthetic.sweep.spec | fields})
    return synthetic


def with_trials(synthetic: Synthetic, **fields: Any) -> Synthetic:
    synthetic.trials[:] = [trial.model_copy(update=fields) for trial in synthetic.trials]
    return synthetic


def facts_of(synthetic: Synthetic) -> dict[str, str]:
    return dict(cost.section(source_of(synthetic)).facts)


def packed_pair(**fields: Any) -> Synthetic:
    """Two trials of one pack, of 10 s in all, each of half of it."""
    synthetic = make_sweep(points=[{"lr": 1e-7}, {"lr": 2e-7}], with_best=False)
    known = {"node": "a", "pid": 1, "engine": "packed", "started_at": 0.0, "ended_at": 10.0, "time_s": 10.0}
    return with_trials(synthetic, **known | fields)


def test_the_cost_of_a_pack_is_shared_by_its_trials() -> None:
    synthetic = packed_pair()
    facts = facts_of(synthetic)
    steps = [trial.num_env_steps for trial in synthetic.trials]
    assert facts["env steps"] == f"{sum(steps):,} in 2 trials, {steps[0]:,} each"
    assert facts["core-seconds"] == "10 in training, 5 each"
    assert facts["speed"] == f"{round(sum(steps) / 10):,} env steps a core-second, evaluations included"
    assert facts["wall time"] == "1 min 10 s, of which 10 s in training with 1.0 cores busy in the mean"
    assert any("estimated" in note for note in cost.section(source_of(synthetic)).notes)
    table = all_trials.section(source_of(synthetic)).table
    column = table.headings.index("core-seconds")
    assert [row[column].text for row in table.rows] == ["5.0", "5.0"]


@pytest.mark.parametrize(("num_env_steps", "said"), [(2, "0.4"), (7, "1.4"), (499, "99.8"), (501, "100"), (517, "103")])
def test_a_slow_env_has_a_speed(num_env_steps: int, said: str) -> None:
    synthetic = packed_pair()
    facts = facts_of(with_trials(synthetic, num_env_steps=num_env_steps))
    assert facts["speed"] == f"{said} env steps a core-second, evaluations included"


def test_the_spread_of_what_trials_cost_is_told_in_whole_numbers() -> None:
    synthetic = packed_pair()
    synthetic.trials[:] = [
        trial.model_copy(update={"num_env_steps": steps, "node": node, "ended_at": time_s, "time_s": time_s})
        for trial, steps, time_s, node in zip(
            synthetic.trials, (51_200, 102_403), (12345.6, 23456.7), ("a", "b"), strict=True
        )
    ]
    facts = facts_of(with_trials(synthetic, engine="rllib"))
    assert facts["env steps"].endswith("; a trial 51,200 to 102,403, median 76,802")
    assert facts["core-seconds"].endswith("; a trial 12,346 to 23,457, median 17,901")


@pytest.mark.parametrize(
    ("state", "run_time_s", "said"),
    [("running", 0.0, None), ("running", 70.4, "1 min 10 s before this run"), ("interrupted", 70.4, "1 min 10 s")],
)
def test_the_time_of_a_run_under_way_is_not_said_to_be_none(state: str, run_time_s: float, said: str | None) -> None:
    synthetic = make_sweep(points=[{"lr": 1e-7}], with_best=False)
    synthetic.sweep = synthetic.sweep.model_copy(update={"state": state, "run_time_s": run_time_s})
    source = source_of(synthetic)
    assert dict(head.section(source).facts).get("wall time") == said
    assert dict(repeat.section(source).facts).get("time in all") == said
    assert dict(cost.section(source).facts).get("wall time") == said


def test_a_trial_in_a_process_of_its_own_is_not_called_an_estimate() -> None:
    assert cost.section(source_of(packed_pair(engine="rllib", pid=None))).notes == []


@pytest.mark.parametrize(
    ("status", "reason", "said"),
    [
        ("stopped", "asha", "the scheduler ended 2 trials before 100,000 env steps, which saved 50 % of the env steps"),
        ("completed", "training_return 195.2 >= 195", "reaching the goal ended 2 trials before 100,000 env steps"),
        ("completed", "num_env_steps 100352 >= 100000", "no trial was ended before its last env step"),
    ],
)
def test_what_early_stopping_saved_is_told(status: str, reason: str, said: str) -> None:
    synthetic = with_spec(packed_pair(status=status, stop_reason=reason), stop={"num_env_steps": 100_000})
    assert facts_of(synthetic)["early stopping"].startswith(said)


def test_what_is_not_known_of_the_cost_is_said() -> None:
    facts = facts_of(packed_pair(node=None, pid=None))
    assert facts["core-seconds"] == "not known: the trials' records don't say when and where they ran"
    assert "speed" not in facts
    assert cost.section(source_of(make_sweep(points=[]))).facts == []


def steps_of(synthetic: Synthetic) -> dict[str, Step]:
    return {step.title: step for step in next_steps.section(source_of(synthetic)).steps}


def ppo_sweep() -> Synthetic:
    synthetic = make_sweep(points=make_points(3, np.random.default_rng(0)))
    for index, trial in enumerate(synthetic.trials):
        values = PPOHyperparams(num_envs=8, gamma=0.98, **trial.point)
        synthetic.trials[index] = trial.model_copy(update={"hyperparams": values.model_dump(mode="json")})
    space = {
        "hidden_sizes": {"grid": [[32], [64]]},
        "activation": {"grid": ["linear", "relu"]},
        "lr": {"loguniform": [1e-7, 1e-2]},
    }
    stop = {"training_return": 195.0, "num_env_steps": 50_000, "time_s": 3600.0, "evaluation_return": None}
    return with_spec(synthetic, space=space, stop=stop, env={"id": "CartPole-v1", "args": {}, "frame_stack": 1})


def test_next_steps_are_commands_and_sweep_files_that_can_be_launched() -> None:
    synthetic = ppo_sweep()
    steps = steps_of(synthetic)
    assert list(steps) == [
        "Replicate", "Extend", "Search a narrower space", "Train the setting by itself",
        "The setting in Stable-Baselines3", "The setting in RLlib",
    ]  # fmt: skip
    assert steps["Replicate"].text == "tune-jobs replicate sweep"
    assert steps["Extend"].text == "tune-jobs extend sweep --num-samples 5"
    settings = source_of(synthetic).settings
    assert settings is not None
    alone = load_spec(yaml.safe_load(steps["Train the setting by itself"].text))
    assert not alone.space
    assert alone.seed == 1
    assert alone.seeds_per_point == 5
    assert alone.hyperparams == {"num_envs": 8, "gamma": 0.98} | settings.best.point
    narrower = yaml.safe_load(steps["Search a narrower space"].text)
    assert load_spec(narrower).num_samples == 5
    low, high = narrower["space"]["lr"]["loguniform"]
    assert 1e-7 < low < settings.best.point["lr"] < high <= 1e-2


def test_next_steps_run_failed_trials_again_unless_the_sweep_goes_on_first() -> None:
    synthetic = ppo_sweep()
    synthetic.trials[0] = synthetic.trials[0].model_copy(update={"status": "failed", "error": "it broke"})
    assert steps_of(synthetic)["Retry"].text == "tune-jobs resume sweep --retry-failed"
    synthetic.sweep = synthetic.sweep.model_copy(update={"state": "interrupted"})
    steps = steps_of(synthetic)
    assert steps["Go on"].text == "tune-jobs resume sweep"
    assert "Retry" not in steps
    # One that runs refuses it.
    synthetic.sweep = synthetic.sweep.model_copy(update={"state": "running"})
    assert "Retry" not in steps_of(synthetic)


def test_next_steps_keep_all_arguments_of_the_environment() -> None:
    args = {"map_name": None, "x": {}, "y": {"z": None}}
    steps = steps_of(with_spec(ppo_sweep(), env={"id": "CartPole-v1", "args": args, "frame_stack": 1, "atari": None}))
    for title in ("Search a narrower space", "Train the setting by itself"):
        content = yaml.safe_load(steps[title].text)
        assert content["env"] == {"id": "CartPole-v1", "args": args, "frame_stack": 1}
        assert load_spec(content).env.args == args


def test_next_steps_leave_out_the_earlier_sweeps_that_a_search_began_with() -> None:
    # A search of a narrower space, or none, could be refused for them.
    steps = steps_of(with_spec(ppo_sweep(), search={"type": "gp", "num_startup_trials": 3}, prior=["earlier"]))
    for title in ("Search a narrower space", "Train the setting by itself"):
        assert load_spec(yaml.safe_load(steps[title].text)).prior == ()


def test_what_has_no_setting_has_no_steps_with_one() -> None:
    assert list(steps_of(with_spec(ppo_sweep(), scheduler={"type": "pbt"}))) == ["Extend"]
    assert steps_of(make_sweep(points=[{}], algorithm="random")) == {}
    assert "Replicate" not in steps_of(make_sweep(points=[{"lr": 1e-3}]))
    grid = with_spec(ppo_sweep(), space={"lr": {"grid": [1e-3, 3e-3]}})
    assert "Extend" not in steps_of(grid)
    stopped = ppo_sweep()
    stopped.sweep = stopped.sweep.model_copy(update={"state": "interrupted"})
    assert next(iter(steps_of(stopped).values())).text == "tune-jobs resume sweep"


@pytest.mark.parametrize(
    ("domain", "values", "narrowed"),
    [
        ({"grid": [[32], [64], [128]]}, [[64], [32]], {"grid": [[32], [64]]}),
        ({"choice": [True, 1, "a"]}, [1], {"choice": [1]}),
        ({"grid": [1, 2]}, [3], {"grid": [1, 2]}),
        ({"uniform": [0.0, 1.0]}, [0.4, 0.8], {"uniform": [0.3, 0.9]}),
        ({"uniform": [0.0, 1.0]}, [0.1, 0.9], {"uniform": [0.05, 1.0]}),
        ({"loguniform": [1e-6, 1.0]}, [1e-4, 1e-2], {"loguniform": [5e-5, 0.0316]}),
        ({"uniform": [0.9, 0.9999]}, [0.9958, 0.9960, 0.9964], {"uniform": [0.9957, 0.9965]}),
        ({"uniform": [-5.0, 5.0]}, [-1.2345, -1.2], {"uniform": [-1.24, -1.19]}),
        ({"uniform": [0.0, 1e6]}, [123_456.0, 234_567.0], {"uniform": [95_700.0, 262_000.0]}),
        ({"quniform": [0.0, 1.0, 0.1]}, [0.3, 0.6], {"quniform": [0.2, 0.7, 0.1]}),
        ({"randint": [1, 100]}, [10, 20], {"randint": [7, 24]}),
        ({"qrandint": [0, 100, 10]}, [20, 40], {"qrandint": [10, 50, 10]}),
        ({"quniform": [0.0, 1.0, 0.25]}, [0.5, 0.5], {"quniform": [0.25, 0.75, 0.25]}),
        ({"uniform": [0.0, 1.0]}, [float("nan")], {"uniform": [0.0, 1.0]}),
        ("odd", [1], "odd"),
    ],
)
def test_a_space_is_narrowed_to_where_points_did_well(domain: Any, values: list[Any], narrowed: Any) -> None:
    assert narrowed_space({"x": domain}, [{"x": value} for value in values]) == {"x": narrowed}


def test_what_did_well_is_in_the_narrowed_space() -> None:
    rng = np.random.default_rng(0)
    for _ in range(300):
        kind = ("uniform", "loguniform")[rng.integers(2)]
        low, high = np.sort(10.0 ** rng.uniform(-6, 3, 2)).tolist()
        # Close to each other, where few digits are too few.
        place = rng.uniform(0.0, 1.0) + 10.0 ** rng.uniform(-5, 0) * rng.uniform(0.0, 1.0, rng.integers(1, 5))
        values = np.clip(low + (high - low) * place, low, high).tolist()
        least, most = narrowed_space({"x": {kind: [low, high]}}, [{"x": value} for value in values])["x"][kind]
        assert low <= least <= min(values) <= max(values) <= most <= high


@pytest.mark.parametrize("algorithm", ["ppo", "dqn"])
def test_programs_of_other_libraries_have_the_values_under_their_names(algorithm: Algorithm) -> None:
    values = (
        PPOHyperparams(hidden_sizes=(32,), activation="relu", lr=0.002, train_batch_size=512, num_envs=8, gamma=0.98)
        if algorithm == "ppo"
        else DQNHyperparams(hidden_sizes=(32,), lr=0.002, train_freq=8, num_envs=4, updates_per_env_step=0.5, n_step=3)
    )
    sb3 = stable_baselines3_program(values, env_id="CartPole-v1", env_args={"a": 1}, num_env_steps=50_000)
    rllib = rllib_program(values, env_id="CartPole-v1", env_args={"a": 1})
    for library, program in (("SB3", sb3), ("RLlib", rllib)):
        compile(program.code, library, "exec")
        known = {foreign.name for foreign in FOREIGN_NAMES[algorithm] if foreign.library == library}
        ours = {"policy_kwargs", "ortho_init", "net_arch", "activation_fn", "total_timesteps"}
        other = {"n_envs", "env_kwargs", "env_config", "model_config", "num_env_runners", "num_learners"}
        names = set(re.findall(r"(\w+)=", program.code))
        assert names - known - ours - other == set(), library
    if algorithm == "ppo":
        assert "n_steps=64," in sb3.code  # of each of eight environments
        assert 'vf_clip_param=float("inf")' in rllib.code
        assert sb3.notes == ("SB3 standardises advantages over each minibatch, ours over the whole train batch.",)
        assert rllib.notes == ()
    else:
        assert "train_freq=2," in sb3.code
        assert "gradient_steps=4," in sb3.code
        assert "training_intensity=16.0," in rllib.code
        assert "SB3's DQN lacks double_q, dueling." in sb3.notes


def test_what_other_libraries_lack_is_told() -> None:
    values = PPOHyperparams(
        entropy_coeff=0.01, entropy_coeff_final=0.0, entropy_decay_steps=1000, vf_clip_param=3.0, use_kl_loss=True,
        vf_share_layers=True, initializer="he_uniform", normalize_observations=True, lr_final=0.0, lr_decay_steps=500,
        train_batch_size=1000, num_envs=7, minibatch_size=100,
    )  # fmt: skip
    program = stable_baselines3_program(values, env_id="E", env_args={}, num_env_steps=2_000)
    assert len(program.notes) == 7
    # Ours samples as many, in whole vector steps.
    assert "n_steps=143," in program.code
    assert not any("The train batch" in note for note in program.notes)
    assert "VecNormalize(env, norm_reward=False)" in program.code
    for values, arguments in (
        (PPOHyperparams(normalize_rewards=True, gamma=0.9), "norm_obs=False, gamma=0.9"),
        (PPOHyperparams(normalize_rewards=True, normalize_observations=True, gamma=0.9), "gamma=0.9"),
    ):
        code = stable_baselines3_program(values, env_id="E", env_args={}, num_env_steps=2_000).code
        assert f"env = VecNormalize(env, {arguments})" in code
        assert "normalize_rewards is left out: RLlib has none." in rllib_program(values, env_id="E", env_args={}).notes
    values = PPOHyperparams(vf_clip_range=0.25, normalize_advantages=False)
    sb3 = stable_baselines3_program(values, env_id="E", env_args={}, num_env_steps=2_000)
    assert "clip_range_vf=0.25," in sb3.code
    assert "normalize_advantage=False," in sb3.code
    assert sb3.notes == ("clip_range_vf counts the limited value's error alone, vf_clip_range the larger of two.",)
    assert rllib_program(values, env_id="E", env_args={}).notes == (
        "vf_clip_range is left out: RLlib has none.",
        "normalize_advantages is left out: RLlib always standardises them.",
    )
    for epsilon, lacking in ((1e-6, ()), (1e-3, ("RLlib's DQN lacks prioritized_epsilon.",))):
        prioritized = DQNHyperparams(replay="prioritized", prioritized_epsilon=epsilon)
        assert rllib_program(prioritized, env_id="E", env_args={}).notes == lacking
    (rate,) = [line for line in program.code.splitlines() if "learning_rate" in line]
    schedule = eval(rate.strip().removeprefix("learning_rate=").removesuffix(","))
    assert [schedule(left) for left in (1.0, 0.875, 0.75, 0.0)] == pytest.approx([3e-4, 1.5e-4, 0.0, 0.0])


def test_the_first_trials_stand_in_the_table_and_the_others_in_its_data() -> None:
    synthetic = make_sweep(points=[{"lr": 1e-4 * (index + 1)} for index in range(60)], max_steps=6_000)
    found = all_trials.section(source_of(synthetic))
    assert found.table.headings[:3] == ["score", "trial", "status"]
    assert (len(found.table.rows), found.num_trials) == (50, 60)
    more = json.loads(found.more)
    ids = [row[1].text for row in found.table.rows] + [row[1][1] for row in more]
    assert set(ids) == {trial.trial_id for trial in synthetic.trials}
    scores = [row[0].value for row in found.table.rows] + [row[0][0] for row in more]
    assert scores == sorted(scores, reverse=True)


def test_the_data_of_the_table_cannot_end_their_element() -> None:
    hostile = "</script><script>alert(1)</script><!--&amp;"
    synthetic = make_sweep(points=[{"activation": hostile}] * 60, max_steps=6_000)
    more = all_trials.section(source_of(synthetic)).more
    assert not set("<>&") & set(more)
    assert json.loads(more)[0][3][1] == hostile


def failed(index: int, error: str) -> TrialRecord:
    return make_sweep(points=[{"lr": 1e-3}] * (index + 1), failed={index}, error=error, with_best=False).trials[index]


def test_failures_with_one_cause_are_told_once() -> None:
    trials = [failed(index, f"ValueError: {'one' if index % 3 else 'other'}\nof {index}") for index in range(8)]
    one, other = all_trials.failures(trials)
    assert (one.summary, one.num_trials, other.num_trials) == ("ValueError: one", 5, 3)
    assert (one.anchor, one.text) == ("error-t0001", "ValueError: one\nof 1")
    assert [member[0] for member in one.members] == ["t0001", "t0002", "t0004", "t0005", "t0007"]


def test_thousands_of_failures_are_a_small_section() -> None:
    synthetic = make_sweep(points=[{"lr": 1e-3}] * 3, failed=range(3), error="E: same", with_best=False)
    one = synthetic.trials[0]
    many = [one.model_copy(update={"trial_id": f"t{index:04d}", "index": index}) for index in range(5_000)]
    different = [
        trial.model_copy(update={"trial_id": f"t{5_000 + index}", "error": f"E: {index}\n" + "x" * 9_999})
        for index, trial in enumerate(many[:40])
    ]
    synthetic.trials[:] = many + different
    found = all_trials.section(source_of(synthetic))
    assert (found.failures[0].num_trials, len(found.failures[0].members)) == (5_000, 20)
    assert (len(found.failures), found.num_other_causes) == (20, 21)
    assert sum(len(failure.text) for failure in found.failures) < 100_000
    assert found.table.rows[0][2].href == "#error-t0000"
    assert found.failures[0].anchor == "error-t0000"


def test_every_hyperparameter_is_told_with_its_default_and_other_names() -> None:
    table = repeat.section(source_of(ppo_sweep())).hyperparams
    rows = {row[0].text: [cell.text for cell in row[1:]] for row in table.rows}
    assert list(rows) == list(PPOHyperparams.model_fields)
    assert rows["lr"] == ["searched, loguniform from 1e-07 to 0.01", "0.0003", "learning_rate", "lr, lr_schedule"]
    assert rows["hidden_sizes"][0] == "searched, grid of 32, 64"
    assert rows["gamma"][:2] == ["0.98", "0.99"]
    assert rows["grad_clip"][:2] == ["null", "null"]
    assert rows["vf_share_layers"][:2] == ["false", "false"]
    assert repeat.hyperparam_table(with_spec(ppo_sweep(), algorithm="none of ours").sweep).rows == []


def test_the_command_and_the_machine_are_told() -> None:
    synthetic = ppo_sweep()
    found = repeat.section(source_of(synthetic))
    assert found.reproduce == f"tune-jobs reproduce sweep/{present(synthetic.best).checkpoint.trial_id}"
    assert repeat.section(source_of(make_sweep(failed=range(20)))).reproduce == ""
    # A trial of a population went on from others' checkpoints, and `reproduce` refuses it.
    assert repeat.section(source_of(with_spec(synthetic, scheduler={"type": "pb2"}))).reproduce == ""
    assert found.command == "tune-jobs launch cartpole-ppo-1.yaml --name cartpole-ppo-1-again"
    assert dict(found.facts)["CPU"] == "not recorded; other CPUs round differently"
    assert dict(found.facts)["python"] == "3.11.7"
    known = with_trials(ppo_sweep(), ran_with={"cpu": "A CPU", "instructions": "avx2"})
    assert dict(repeat.section(source_of(known)).facts)["CPU"] == "A CPU, avx2"
